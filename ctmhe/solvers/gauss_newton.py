"""Generalized Gauss-Newton on the multiple-shooting problem: linearise, solve the structured QP, globalise, repeat."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from threading import local

import numpy as np

from ctmhe.solvers.base import Multipliers, Solution, clip_to_bounds
from ctmhe.solvers.quadratic import KKT, ActiveSet, QuadraticProgram, Singular, Step
from ctmhe.transcription.problem import Guess, Window, bound_violation, cost_of, prior_deviation
from ctmhe.transcription.stage import Linearization, StageFunction
from ctmhe.types import Array, Outcome

ARMIJO = 1e-4
DAMPING_START, DAMPING_LIMIT = 1e-8, 1e8
ROUND_OFF = 1e-15
SETTLED = 25  # iterations after which the penalty only grows
MEMORY = 4  # iterates that the merit function may fall back on
SHORT = 0.1  # share of a step, below which the next is damped more
HIDDEN = 5.0  # what defects may hide of J/2, against the decrease that is small enough to stop
SLOW = 0.05  # predicted decreases that shrink by less than this factor call for second derivatives


@dataclass(frozen=True, eq=False)
class _Iterate:
    point: Guess
    linear: Linearization
    cost: float
    defect: Array  # (N, nx), scaled
    y_excess: Array  # (N, ny), scaled violation of the output bounds

    @property
    def infeasibility(self) -> float:
        return float(np.abs(self.defect).sum() + self.y_excess.sum())


class GaussNewton:
    """The default solver.

    Each iteration linearises all slots, solves the quadratic program with its bounds, and takes a step that decreases
    the exact penalty function J/2 + rho (|dynamics defect|_1 + |output bound excess|_1) below the largest of its last
    values, backtracking where needed;
    when no step does, a Levenberg term is added and raised. It stops when the predicted decrease falls below
    `tolerance` relative to the cost and the dynamics hold. Gauss-Newton converges linearly where residuals are large
    and the model is curved; when that is slow, the second derivatives of the stage (symbolic models) are added and
    the last iterations are Newton's.

    Parameters
    ----------
    stage : StageFunction
    max_iterations : int
    deadline : float, optional
        Seconds by `clock` after which no further iteration begins.
    tolerance : float
        Relative predicted decrease of the cost at which a full step is the last.
    """

    name = "Gauss-Newton"

    def __init__(
        self,
        stage: StageFunction,
        *,
        max_iterations: int = 100,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
        tolerance: float = 1e-11,
    ):
        self.stage, self.max_iterations, self.tolerance = stage, max_iterations, tolerance
        self.deadline, self.clock = deadline, clock
        self._scratch = local()  # one set of KKT systems a thread

    def solve(self, window: Window, guess: Guess) -> Solution:
        """Return the solution from `guess`; never raises for numerical trouble."""
        with np.errstate(all="ignore"):  # a trial step may leave the model's domain: that is judged, not warned of
            return self._solve(window, guess)

    def _solve(self, window: Window, guess: Guess) -> Solution:
        kkt = self._system(window)
        data, unit = self._data_scale(window)
        factorizations, damping, rho = 0, 0.0, 0.0
        step: Step | None = None
        optimality = last_decrease = float("nan")
        newton = False
        guess = clip_to_bounds(window, guess)
        active = ActiveSet(guess.x_active, guess.w_active, guess.y_active, guess.p_active[: kkt.np])
        active = _admissible(window, active, bool(kkt.ny))
        try:
            current = self._evaluate(window, guess)
        except FloatingPointError as error:
            return self._failed(window, guess, str(error))
        if not np.isfinite(current.cost):
            return self._failed(window, guess, "the model is not finite at the guess")
        recent = deque([(current.cost, current.infeasibility)], maxlen=MEMORY)
        message, success = f"no convergence in {self.max_iterations} iterations", False
        iteration, stopped, began = 0, None, self.clock()
        while iteration < self.max_iterations:
            if iteration and self.deadline is not None and self.clock() - began >= self.deadline:
                message, stopped = f"no convergence in {self.deadline} s", Outcome.DEADLINE
                break
            iteration += 1
            qp = self._quadratic_program(window, current, kkt, step if newton else None)
            try:
                step = kkt.solve(qp, active, damping=damping)
            except Singular as error:
                if newton:
                    newton, last_decrease = False, float("nan")
                    continue
                damping = max(10 * damping, DAMPING_START * _typical_curvature(qp))
                if damping > DAMPING_LIMIT * _typical_curvature(qp):
                    message = str(error)
                    break
                active = _admissible(window, ActiveSet(*(np.zeros_like(a) for a in _parts(active))), bool(kkt.ny))
                continue
            factorizations += step.factorizations
            active = step.active
            predicted, optimality = self._model_decrease(qp, step)
            duals = max(float(np.abs(part).max(initial=0.0)) for part in (step.dynamics, step.zy))
            # the first multipliers may be far too large: the penalty may follow them down, but not for ever
            rho = 1.5 * duals if iteration <= SETTLED else max(rho, 1.5 * duals)
            if damping == 0.0 and self._feasible(current) and _largest(step) <= 100 * self.stage.accuracy:
                message, success = "converged to the accuracy of the integrator", True
                break
            trial, alpha = self._line_search(window, current, step, rho, predicted, recent)
            if trial is None and newton:
                newton, last_decrease = False, float("nan")
                continue
            typical = _typical_curvature(qp)
            raised = max(10 * damping, DAMPING_START * typical)
            if trial is None:
                damping = raised
                if damping > DAMPING_LIMIT * typical:
                    message = "no step decreases the merit function"
                    break
                continue
            light = damping <= 10 * DAMPING_START * typical  # else the small step is the damping's doing
            if alpha < SHORT:  # the linear model does not reach that far: a shorter step next
                damping = raised if raised < DAMPING_LIMIT * typical else damping
            else:
                damping = 0.0 if damping < DAMPING_START * typical else 0.1 * damping
            slow = iteration > 4 and abs(predicted) > SLOW * abs(last_decrease)
            newton = self.stage.symbolic and alpha == 1.0 and (newton or slow)
            last_decrease = predicted
            current = trial
            recent.append((current.cost, current.infeasibility))
            noise = ROUND_OFF * np.sqrt(current.cost * data) + self.stage.accuracy**2 * data + ROUND_OFF**2 * unit
            enough = self.tolerance * current.cost + noise
            hidden = abs(float(np.sum(step.dynamics * current.defect)))  # of J/2, by the defects, to first order
            small = abs(predicted) <= enough and alpha == 1.0
            settled = hidden <= HIDDEN * enough or np.abs(current.defect).max(initial=0.0) <= 10 * self.stage.accuracy
            if small and light and settled and self._feasible(current):
                message, success = "converged", True
                break
        else:
            stopped = Outcome.ITERATION_LIMIT
        point = current.point
        feasibility = max(
            float(np.abs(current.defect).max(initial=0.0)), bound_violation(window, point, self._y_end(current))
        )
        multipliers = None
        if step is not None:
            p_active = np.zeros(self.stage.np, dtype=np.int8)
            p_active[: kkt.np] = active.p
            ny_active = active.y if kkt.ny else np.zeros((len(window.mesh), self.stage.ny), dtype=np.int8)
            point = Guess(point.x, point.w, point.p, active.x, active.w, ny_active, p_active)
            multipliers = Multipliers(step.dynamics, step.zx, step.zw, step.zy, step.zp)
        return Solution(
            point,
            current.linear.y,
            current.cost,
            success,
            message,
            iteration,
            optimality,
            feasibility,
            factorizations,
            multipliers,
            stopped,
        )

    def _system(self, window: Window) -> KKT:
        systems: dict[tuple[bool, bool], KKT] | None = getattr(self._scratch, "systems", None)
        if systems is None:
            systems = self._scratch.systems = {}
        key = (window.output_bounded, window.p_estimated)
        if key not in systems:
            stage = self.stage
            systems[key] = KKT(stage.nx, stage.nw, stage.ny * key[0], stage.np * key[1])
        return systems[key]

    def _data_scale(self, window: Window) -> tuple[float, float]:
        """Return the cost of explaining nothing, what round-off in the residuals is relative to, and that of
        residuals as large as the signals' scales: where the data are zero, round-off is relative to these.
        """
        data = float(np.sum((window.L_y @ window.y_data[..., None]) ** 2))
        prior = float(np.sum((window.L_prior @ window.prior[: len(window.L_prior)]) ** 2))
        scale = np.concatenate([window.x_scale, window.p_scale])[: len(window.L_prior)]
        weighted = (window.L_prior * scale, window.L_w * window.w_scale, window.L_y * window.y_scale)
        return data + prior + 1e-300, sum(float(np.sum(part**2)) for part in weighted)

    def _feasible(self, current: _Iterate) -> bool:
        limit = max(1e-8, 10 * self.stage.accuracy)
        return max(float(np.abs(v).max(initial=0.0)) for v in (current.defect, current.y_excess)) <= limit

    def _y_end(self, current: _Iterate) -> Array:
        return current.linear.y[:, -1]

    def _evaluate(self, window: Window, point: Guess) -> _Iterate:
        mesh = window.mesh
        linear = self.stage.linearize(mesh.t[:-1], mesh.h, point.x[:-1], point.w, point.p, window.u0, window.u1)
        return self._judge(window, point, linear)

    def _judge(self, window: Window, point: Guess, linear: Linearization) -> _Iterate:
        defect = (linear.x_next - point.x[1:]) / window.x_scale
        y_end = linear.y[:, -1]
        excess = np.maximum(np.maximum(window.y_lower - y_end, y_end - window.y_upper), 0.0) / window.y_scale
        return _Iterate(point, linear, cost_of(window, point, linear.y), defect, excess)

    def _line_search(
        self,
        window: Window,
        current: _Iterate,
        step: Step,
        rho: float,
        predicted: float,
        recent: Iterable[tuple[float, float]],
    ) -> tuple[_Iterate | None, float]:
        # not above the worst of the last few: curved dynamics would cut good full steps (the Maratos effect)
        merit = max(cost / 2 + rho * infeasibility for cost, infeasibility in recent)
        # directional derivative of the exact penalty along the step: model slope minus removed infeasibility
        slope = -max(predicted, 0.0) - rho * current.infeasibility
        noise = 1e-13 * max(merit, 1e-300)
        alpha = 1.0
        for _ in range(12):
            point = self._move(window, current.point, step, alpha)
            try:
                trial = self._evaluate(window, point)
            except FloatingPointError:
                alpha /= 4
                continue
            value = trial.cost / 2 + rho * trial.infeasibility
            if np.isfinite(value) and value <= merit + ARMIJO * alpha * slope + noise:
                return trial, alpha
            alpha /= 2
        return None, 0.0

    def _move(self, window: Window, point: Guess, step: Step, alpha: float) -> Guess:
        x = np.clip(point.x + alpha * step.dx * window.x_scale, window.x_lower, window.x_upper)
        w = point.w + alpha * step.dw * window.w_scale
        p = point.p.copy()
        if window.p_estimated:
            p = np.clip(p + alpha * step.dp * window.p_scale, window.p_lower, window.p_upper)
        w = np.clip(w, window.w_lower, window.w_upper)
        return Guess(x, w, p, point.x_active, point.w_active, point.y_active, point.p_active)

    def _model_decrease(self, qp: QuadraticProgram, step: Step) -> tuple[float, float]:
        """Return the predicted decrease of J/2 along the step, and the scaled stationarity residual before it."""
        x, w, p = step.dx[:-1], step.dw, step.dp
        Hx = (qp.Hxx @ x[..., None] + qp.Hxw @ w[..., None])[..., 0] + qp.Hxp @ p
        Hw = (qp.Hxw.transpose(0, 2, 1) @ x[..., None] + qp.Hww @ w[..., None])[..., 0] + qp.Hwp @ p
        Hp = qp.Hpp @ p + np.einsum("kip,ki->p", qp.Hxp, x) + np.einsum("kip,ki->p", qp.Hwp, w)
        slope = float(np.sum(qp.gx * step.dx) + np.sum(qp.gw * w) + qp.gp @ p)
        curvature = float(np.sum(Hx * x) + np.sum(Hw * w) + Hp @ p)
        size = max(float(np.abs(g).max(initial=0.0)) for g in (qp.gx, qp.gw, qp.gp, step.dynamics))
        residual = max(float(np.abs(g).max(initial=0.0)) for g in (Hx, Hw, Hp))
        return -(slope + curvature / 2), residual / max(size, 1e-300)

    def _curvature(self, window: Window, current: _Iterate, multipliers: Step) -> Array:
        """Return the second-order terms of the Lagrangian per slot (N, n, n) in (x, w, p), unscaled."""
        point, mesh, linear = current.point, window.mesh, current.linear
        residual = (window.L_y @ (linear.y - window.y_data)[..., None])[..., 0]
        lambda_y = (window.L_y.transpose(0, 1, 3, 2) @ residual[..., None])[..., 0]
        if multipliers.zy.shape[1]:
            lambda_y[:, -1] += multipliers.zy / window.y_scale
        lambda_x = multipliers.dynamics / window.x_scale
        arguments = (mesh.t[:-1], mesh.h, point.x[:-1], point.w, point.p, window.u0, window.u1)
        return self.stage.curvature(*arguments, lambda_x, lambda_y.reshape(len(mesh), -1))

    def _quadratic_program(
        self, window: Window, current: _Iterate, kkt: KKT, multipliers: Step | None = None
    ) -> QuadraticProgram:
        stage, point, linear = self.stage, current.point, current.linear
        n, nx, nw, npar = len(window.mesh), stage.nx, stage.nw, kkt.np
        scale = np.concatenate([window.x_scale, window.w_scale, window.p_scale[:npar]])
        jacobian = linear.jacobian[:, :, : nx + nw + npar] * scale
        step_rows = jacobian[:, :nx] / window.x_scale[:, None]
        output_rows = jacobian[:, nx:].reshape(n, stage.q, stage.ny, -1)
        rooted = (window.L_y @ output_rows).reshape(n, stage.q * stage.ny, -1)
        residual = (window.L_y @ (linear.y - window.y_data)[..., None]).reshape(n, -1, 1)
        H = rooted.transpose(0, 2, 1) @ rooted
        if multipliers is not None:
            extra = self._curvature(window, current, multipliers)
            H = H + extra[:, : nx + nw + npar, : nx + nw + npar] * scale[:, None] * scale
        g = (rooted.transpose(0, 2, 1) @ residual)[..., 0]
        root_w = window.L_w * window.w_scale
        Hww = H[:, nx : nx + nw, nx : nx + nw] + root_w.transpose(0, 2, 1) @ root_w
        gw = g[:, nx : nx + nw] + (root_w.transpose(0, 2, 1) @ (window.L_w @ point.w[..., None]))[..., 0]
        gx = np.vstack([g[:, :nx], np.zeros((1, nx))])
        Hxx, Hxp = H[:, :nx, :nx].copy(), H[:, :nx, nx + nw :].copy()
        Hpp, gp = H[:, nx + nw :, nx + nw :].sum(axis=0), g[:, nx + nw :].sum(axis=0)
        root_prior = window.L_prior * np.concatenate([window.x_scale, window.p_scale])[: len(window.L_prior)]
        prior_gradient = root_prior.T @ (window.L_prior @ prior_deviation(window, point))
        prior_hessian = root_prior.T @ root_prior
        Hxx[0] += prior_hessian[:nx, :nx]
        gx[0] += prior_gradient[:nx]
        if npar:
            Hxp[0] += prior_hessian[:nx, nx:]
            Hpp += prior_hessian[nx:, nx:]
            gp = gp + prior_gradient[nx:]
        end = output_rows[:, -1] / window.y_scale[:, None]
        y_end = linear.y[:, -1]
        ny = kkt.ny
        x_lower, x_upper = (window.x_lower - point.x) / window.x_scale, (window.x_upper - point.x) / window.x_scale
        w_lower, w_upper = (window.w_lower - point.w) / window.w_scale, (window.w_upper - point.w) / window.w_scale
        x_lower, x_upper, w_lower, w_upper = _without_copies(window, x_lower, x_upper, w_lower, w_upper)
        return QuadraticProgram(
            Hxx=Hxx,
            Hxw=H[:, :nx, nx : nx + nw],
            Hww=Hww,
            Hxp=Hxp,
            Hwp=H[:, nx : nx + nw, nx + nw :],
            Hpp=Hpp,
            gx=gx,
            gw=gw,
            gp=gp,
            A=step_rows[:, :, :nx],
            B=step_rows[:, :, nx : nx + nw],
            E=step_rows[:, :, nx + nw :],
            c=current.defect,
            C=end[:, :ny, :nx],
            D=end[:, :ny, nx : nx + nw],
            F=end[:, :ny, nx + nw :],
            x_lower=x_lower,
            x_upper=x_upper,
            w_lower=w_lower,
            w_upper=w_upper,
            y_lower=((window.y_lower - y_end) / window.y_scale)[:, :ny],
            y_upper=((window.y_upper - y_end) / window.y_scale)[:, :ny],
            p_lower=((window.p_lower - point.p) / window.p_scale)[:npar],
            p_upper=((window.p_upper - point.p) / window.p_scale)[:npar],
            shared=window.mesh.shared,
        )

    def covariance(self, window: Window, point: Guess) -> tuple[Array, int]:
        """Return the covariance of (x at the window's end, estimated p) and the number of determined directions.

        The inverse of half the Gauss-Newton Hessian of J, reduced by the dynamics; active bounds are ignored. Found
        from the KKT system with two small regularisations: directions whose variance grows in proportion are not
        determined, and the variances of the signals in them are infinite.
        """
        stage = self.stage
        kkt = KKT(stage.nx, stage.nw, 0, stage.np * window.p_estimated)
        size = stage.nx + kkt.np
        try:
            with np.errstate(all="ignore"):
                current = self._evaluate(window, point)
                window = _equilibrated(window, self._quadratic_program(window, current, kkt))
                qp = self._quadratic_program(window, self._judge(window, point, current.linear), kkt)
                small, large = (kkt.end_covariance(qp, factor) for factor in (1e-13, 1e-12))
        except (Singular, FloatingPointError):
            return np.where(np.eye(size, dtype=bool), np.inf, np.nan), 0
        values, vectors = np.linalg.eigh((small + small.T) / 2)
        undetermined = values > 3.0 * np.abs(np.einsum("ji,jk,ki->i", vectors, large, vectors))
        kept = vectors[:, ~undetermined]
        covariance = kept @ np.diag(values[~undetermined]) @ kept.T
        if not undetermined.any():
            with suppress(Singular):
                covariance = kkt.end_covariance(qp, 0.0)
                covariance = (covariance + covariance.T) / 2
        scale = np.concatenate([window.x_scale, window.p_scale[: kkt.np]])
        covariance = covariance * scale[:, None] * scale
        for i in np.flatnonzero((np.abs(vectors[:, undetermined]) > 1e-5).any(axis=1)):
            covariance[i, :] = covariance[:, i] = np.nan
            covariance[i, i] = np.inf
        return covariance, int(size - undetermined.sum())

    def _failed(self, window: Window, guess: Guess, message: str) -> Solution:
        y = np.full((len(window.mesh), self.stage.q, self.stage.ny), np.nan)
        return Solution(guess, y, float("inf"), False, message)


def _equilibrated(window: Window, qp: QuadraticProgram) -> Window:
    """Return the window with scales that give every signal a curvature of about one, whatever its unit."""

    def scaled(scale: Array, diagonal: Array) -> Array:
        return np.where(diagonal > 0, scale / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), scale)

    diagonals = [np.einsum("kii->ki", H).max(axis=0, initial=0.0) for H in (qp.Hxx, qp.Hww)]
    p_scale = window.p_scale.copy()
    p_scale[: len(qp.Hpp)] = scaled(p_scale[: len(qp.Hpp)], np.diagonal(qp.Hpp))
    return replace(
        window,
        x_scale=scaled(window.x_scale, diagonals[0]),
        w_scale=scaled(window.w_scale, diagonals[1]),
        p_scale=p_scale,
    )


def _parts(active: ActiveSet) -> tuple[np.ndarray, ...]:
    return active.x, active.w, active.y, active.p


def _largest(step: Step) -> float:
    """Return the largest component of a step, relative to the signals' scales."""
    return max(float(np.abs(part).max(initial=0.0)) for part in (step.dx, step.dw, step.dp))


def _typical_curvature(qp: QuadraticProgram) -> float:
    largest = max(float(np.abs(H).max(initial=0.0)) for H in (qp.Hxx, qp.Hww, qp.Hpp))
    return largest if largest > 0 else 1.0


def _without_copies(window: Window, *bounds: Array) -> tuple[Array, ...]:
    """Drop bounds on copies: w of a slot that shares it with the one before, x behind a slot of no length."""
    shared, still = window.mesh.shared[:-1], window.mesh.h == 0.0
    copies = [np.concatenate([[False], still]), np.concatenate([[False], shared])]
    free = (-np.inf, np.inf)
    return tuple(
        np.where(copies[i // 2][:, None], free[i % 2], bound) if copies[i // 2].any() else bound
        for i, bound in enumerate(bounds)
    )


def _admissible(window: Window, active: ActiveSet, output_bounded: bool) -> ActiveSet:
    """Return the guess of an active set without entries whose bound is infinite or a copy."""
    x_lower, x_upper, w_lower, w_upper = _without_copies(
        window, window.x_lower, window.x_upper, window.w_lower, window.w_upper
    )
    n_p = len(active.p)
    y = active.y if output_bounded else active.y[:, :0]
    ny = y.shape[1]
    triples = (
        (active.x, x_lower, x_upper),
        (active.w, w_lower, w_upper),
        (y, window.y_lower[:, :ny], window.y_upper[:, :ny]),
        (active.p, window.p_lower[:n_p], window.p_upper[:n_p]),
    )
    cleaned = []
    for held, lower, upper in triples:
        possible = np.where(held < 0, np.isfinite(lower), np.isfinite(upper)) & (held != 0)
        cleaned.append(np.where(lower == upper, 1, np.where(possible, held, 0)).astype(np.int8))
    return ActiveSet(*cleaned)
