"""IPOPT on the whole multiple-shooting problem: the reference that every other solver is checked against."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from threading import Lock
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.solvers.base import Multipliers, Solution, clip_to_bounds
from ctmhe.transcription.problem import Guess, Window, bound_violation, cost_of
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Outcome

logger = logging.getLogger(__name__)

OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-10,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.compl_inf_tol": 1e-10,
    "ipopt.acceptable_iter": 0,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 200,
    "show_eval_warnings": False,
    "calc_lam_p": False,
}

SMALLEST = 4  # slots that a program has room for at least
EXPANDED = 5_000  # instructions of all slots up to which the program is expanded to scalars
LARGE = 20_000  # instructions of a slot up to which it becomes one scalar expression


@dataclass(frozen=True, eq=False)
class _Program:
    capacity: int
    solver: ca.Function
    slots: int  # rows of g that belong to dynamics
    shares: int  # rows of g that tie disturbances


class Ipopt:
    """The reference solver.

    Its NLP has a capacity of slots that doubles when a window needs more (logged); spare slots have length zero,
    everything on them is fixed and their equations are switched off. Cells that are split share their w through
    differences that are fixed to zero by bounds, so the structure never changes. The Hessian is exact for models of
    scalar expressions, Gauss-Newton otherwise.

    Parameters
    ----------
    stage : StageFunction
    options : mapping, optional
        IPOPT options that replace the defaults (`tol=1e-10`, `bound_relax_factor=0`).
    max_iterations : int, optional
        Stop there; the iterate need not be feasible. 200, after which a solve has failed, when left out.
    """

    name = "IPOPT"

    def __init__(
        self, stage: StageFunction, *, options: dict[str, Any] | None = None, max_iterations: int | None = None
    ):
        self.stage, self.limited = stage, max_iterations is not None
        limit = {"ipopt.max_iter": max_iterations} if self.limited else {}
        self.options = OPTIONS | limit | (options or {})
        self.built = 0
        self._programs: dict[bool, _Program] = {}
        self._lock = Lock()  # statistics belong to the last call: one at a time

    def solve(self, window: Window, guess: Guess) -> Solution:
        """Return the solution from `guess`; never raises for numerical trouble."""
        with self._lock, np.errstate(all="ignore"):  # where it diverges, its cost may overflow
            return self._solve(window, guess)

    def _solve(self, window: Window, guess: Guess) -> Solution:
        n, stage = len(window.mesh), self.stage
        program = self._program(n, window.output_bounded)
        size = program.capacity
        guess = clip_to_bounds(window, guess)
        x_scale, w_scale = np.tile(window.x_scale, size + 1), np.tile(window.w_scale, size)
        x = _extended(guess.x, size + 1)
        w = _extended(guess.w, size, 0.0)
        differences = np.diff(w, axis=0, append=w[-1:])
        start = np.concatenate(
            [
                x.reshape(-1) / x_scale,
                w.reshape(-1) / w_scale,
                (differences / window.w_scale).reshape(-1),
                guess.p / window.p_scale,
            ]
        )
        lower, upper = (
            self._bounds(window, x[n + 1 :], *sides)
            for sides in (
                (window.x_lower, window.w_lower, window.p_lower, -np.inf),
                (window.x_upper, window.w_upper, window.p_upper, np.inf),
            )
        )
        spare = np.inf * np.ones(program.slots + program.shares)
        spare[: n * stage.nx] = 0.0
        spare[program.slots : program.slots + (n - 1) * stage.nw] = 0.0
        g_lower, g_upper = -spare, spare
        if window.output_bounded:
            g_lower = np.concatenate([g_lower, _extended(window.y_lower / window.y_scale, size, -np.inf).reshape(-1)])
            g_upper = np.concatenate([g_upper, _extended(window.y_upper / window.y_scale, size, np.inf).reshape(-1)])
        try:
            result = program.solver(
                x0=start, p=self._parameters(window, size), lbx=lower, ubx=upper, lbg=g_lower, ubg=g_upper
            )
            statistics: dict[str, Any] = program.solver.stats()
        except RuntimeError as error:
            y = np.full((n, stage.q, stage.ny), np.nan)
            return Solution(guess, y, float("inf"), False, f"IPOPT could not run: {str(error).splitlines()[0]}")
        return self._solution(window, program, result, statistics)

    def _solution(self, window: Window, program: _Program, result: Any, statistics: dict[str, Any]) -> Solution:
        n, stage, size, mesh = len(window.mesh), self.stage, program.capacity, window.mesh
        values = np.asarray(result["x"]).reshape(-1)
        ix, iw = stage.nx * (size + 1), stage.nw * size
        x = values[:ix].reshape(size + 1, stage.nx)[: n + 1] * window.x_scale
        w = values[ix : ix + iw].reshape(size, stage.nw)[:n] * window.w_scale
        p = values[ix + 2 * iw :] * window.p_scale if window.p_estimated else window.prior[stage.nx :].copy()
        bound_z = np.asarray(result["lam_x"]).reshape(-1)
        row_z = np.asarray(result["lam_g"]).reshape(-1)
        zx = bound_z[:ix].reshape(size + 1, stage.nx)[: n + 1]
        zw = bound_z[ix : ix + iw].reshape(size, stage.nw)[:n]
        zp = bound_z[ix + 2 * iw :]
        zy = np.zeros((n, stage.ny))
        if window.output_bounded:
            zy = row_z[program.slots + program.shares :].reshape(size, stage.ny)[:n]
        dynamics = row_z[: program.slots].reshape(size, stage.nx)[:n]
        level = 1e-7 * max(1.0, float(np.abs(dynamics).max(initial=0.0)))
        active = [np.where(np.abs(z) > level, np.sign(z), 0).astype(np.int8) for z in (zx, zw, zy, zp)]
        point = Guess(x, w, p, *active)
        success = bool(statistics.get("success", False))
        status = str(statistics.get("return_status", "unknown"))
        iterations = int(statistics.get("iter_count", 0))
        try:
            x_next, y = self.stage.values(mesh.t[:-1], mesh.h, x[:-1], w, p, window.u0, window.u1)
        except FloatingPointError as error:
            y = np.full((n, stage.q, stage.ny), np.nan)
            return Solution(point, y, float("inf"), False, str(error), iterations)
        defect = float(np.abs((x_next - x[1:]) / window.x_scale).max(initial=0.0))
        feasibility = max(defect, bound_violation(window, point, y[:, -1]))
        return Solution(
            point,
            y,
            cost_of(window, point, y),
            success and feasibility < 1e-6,
            status if success else f"IPOPT: {status}",
            iterations,
            float(statistics.get("iterations", {}).get("inf_du", [float("nan")])[-1]),
            feasibility,
            iterations,
            Multipliers(dynamics, zx, zw, zy, zp),
            Outcome.ITERATION_LIMIT if self.limited and status == "Maximum_Iterations_Exceeded" else None,
        )

    def _program(self, n: int, output_bounded: bool) -> _Program:
        program = self._programs.get(output_bounded)
        if program is None or program.capacity < n:
            capacity = SMALLEST
            while capacity < n:
                capacity *= 2
            logger.info("IPOPT: building the program for %d slots (window has %d)", capacity, n)
            program = self._programs[output_bounded] = self._build(capacity, output_bounded)
            self.built += 1
        return program

    def _build(self, size: int, output_bounded: bool) -> _Program:
        stage = self.stage
        nx, nw, ny, npar, nu, q = stage.nx, stage.nw, stage.ny, stage.np, stage.nu, stage.q
        slot = self._slot_function()
        X, W, D, p = (
            ca.MX.sym(name, rows, columns)
            for name, rows, columns in (("x", nx, size + 1), ("w", nw, size), ("d", nw, size), ("p", npar, 1))
        )
        data = {
            "t": (1, size), "h": (1, size), "u0": (nu, size), "u1": (nu, size), "Lw": (nw * nw, size),
            "Ly": (q * ny * ny, size), "y": (q * ny, size), "prior": (nx + npar, 1), "Lp": (nx + npar, nx + npar),
            "sx": (nx, 1), "sw": (nw, 1), "sp": (npar, 1), "sy": (ny, 1),
        }  # fmt: skip
        d = {name: ca.MX.sym(name, *shape) for name, shape in data.items()}
        scale = {key: ca.repmat(d[f"s{key}"], 1, columns) for key, columns in (("x", size + 1), ("w", size))}
        states, disturbances, parameters = X * scale["x"], W * scale["w"], p * d["sp"]
        x_next, y_end, residuals = slot.map(size)(
            d["t"], d["h"], states[:, :-1], disturbances, ca.repmat(parameters, 1, size), d["u0"], d["u1"],
            d["Lw"], d["Ly"], d["y"],
        )  # fmt: skip
        prior = d["Lp"] @ (ca.vertcat(states[:, 0], parameters) - d["prior"])
        every = ca.vertcat(prior, ca.vec(residuals))
        dynamics = ca.vec((x_next - states[:, 1:]) / ca.repmat(d["sx"], 1, size))
        shares = ca.vec(W[:, 1:] - W[:, :-1] - D[:, :-1])
        constraints = [dynamics, shares]
        if output_bounded:
            constraints.append(ca.vec(y_end / ca.repmat(d["sy"], 1, size)))
        decisions = ca.veccat(X, W, D, p)
        problem = {
            "x": decisions,
            "p": ca.veccat(*d.values()),
            "f": ca.sumsqr(every) / 2,
            "g": ca.vertcat(*constraints),
        }
        options = dict(self.options)
        if self.limited and slot.is_a("SXFunction") and size * slot.n_instructions() < EXPANDED:
            options["expand"] = True  # one scalar program: in few iterations calls are all overhead
        if not stage.symbolic:
            options["hess_lag"] = _gauss_newton_hessian(problem, every)
        solver = ca.nlpsol("reference", "ipopt", problem, options)
        return _Program(size, solver, nx * size, nw * (size - 1))

    def _slot_function(self) -> ca.Function:
        """Return (t, h, x, w, p, u0, u1, L_w, L_y, y_data) -> (x_next, y_end, weighted residuals) of one slot."""
        stage = self.stage
        small = stage.symbolic and stage.steps * stage.value.n_instructions() < LARGE
        kind: Any = ca.SX if small else ca.MX
        symbols = [kind.sym(stage.value.name_in(i), stage.value.size1_in(i)) for i in range(stage.value.n_in())]
        x_next, y = self._chained(symbols) if stage.steps > 1 else stage.value(*symbols)
        ny, nw, q = stage.ny, stage.nw, stage.q
        Lw, Ly, data = kind.sym("Lw", nw * nw), kind.sym("Ly", q * ny * ny), kind.sym("y", q * ny)
        residuals = [ca.reshape(Lw, nw, nw) @ symbols[3]]
        for i in range(q):
            root = ca.reshape(Ly[i * ny * ny : (i + 1) * ny * ny], ny, ny)
            residuals.append(root @ (y[i * ny : (i + 1) * ny] - data[i * ny : (i + 1) * ny]))
        return ca.Function(
            "weighted_slot", [*symbols, Lw, Ly, data], [x_next, y[(q - 1) * ny :], ca.vertcat(*residuals)]
        )

    def _chained(self, symbols: list[Any]) -> tuple[Any, Any]:
        """Return x_next and y (q ny) of a slot of as many steps as it needs; those behind them have length zero."""
        stage, (t, h, x, w, p, u0, u1) = self.stage, symbols
        steps = ca.fmin(ca.fmax(ca.ceil(h / stage.step_length * (1 - 1e-9)), 1), stage.steps)
        inside, ny = len(stage.nodes) * stage.ny, stage.ny
        outputs, end = [], type(x).zeros(ny)
        for i in range(stage.steps):
            begin, stop = ca.fmin(i, steps) / steps, ca.fmin(i + 1, steps) / steps
            inputs = (u0 + (u1 - u0) * begin, u0 + (u1 - u0) * stop)
            x, y = stage.value(t + begin * h, (stop - begin) * h, x, w, p, *inputs)
            if inside:
                outputs.append(y[:inside])
            end = y[inside:]
        return x, ca.vertcat(*outputs, end)

    def _bounds(self, window: Window, spare: Array, x: Array, w: Array, p: Array, free: float) -> Array:
        n, stage = len(window.mesh), self.stage
        size = n + len(spare)
        differences = np.full((size, stage.nw), free)
        differences[np.flatnonzero(window.mesh.shared)] = 0.0
        differences[n:] = 0.0
        fixed = p if window.p_estimated else window.prior[stage.nx :]
        return np.concatenate(
            [
                np.concatenate([x, spare]).reshape(-1) / np.tile(window.x_scale, size + 1),
                _extended(w / window.w_scale, size, 0.0).reshape(-1),
                differences.reshape(-1),
                fixed / window.p_scale,
            ]
        )

    def _parameters(self, window: Window, size: int) -> Array:
        stage, mesh = self.stage, window.mesh
        L_prior = np.zeros((stage.nx + stage.np,) * 2)
        m = len(window.L_prior)
        L_prior[:m, :m] = window.L_prior
        parts = (
            _extended(mesh.t[:-1, None], size),
            _extended(mesh.h[:, None], size, 0.0),
            _extended(window.u0, size),
            _extended(window.u1, size),
            _extended(window.L_w.transpose(0, 2, 1).reshape(len(mesh), -1), size, 0.0),
            _extended(window.L_y.transpose(0, 1, 3, 2).reshape(len(mesh), -1), size, 0.0),
            _extended(window.y_data.reshape(len(mesh), -1), size, 0.0),
            window.prior,
            L_prior.T,
            window.x_scale,
            window.w_scale,
            window.p_scale,
            window.y_scale,
        )
        return np.concatenate([np.ravel(part) for part in parts])


def _extended(rows: Array, size: int, fill: float | None = None) -> Array:
    """Return `rows` lengthened to `size` by `fill`, or by repeating the last."""
    missing = size - len(rows)
    tail = np.repeat(rows[-1:], missing, axis=0) if fill is None else np.full((missing, rows.shape[1]), fill)
    return np.concatenate([rows, tail])


def _gauss_newton_hessian(problem: dict[str, ca.MX], residuals: ca.MX) -> ca.Function:
    jacobian = ca.jacobian(residuals, problem["x"])
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", problem["g"].numel())
    hessian = ca.triu(lam_f * (jacobian.T @ jacobian))
    return ca.Function(
        "nlp_hess_l",
        [problem["x"], problem["p"], lam_f, lam_g],
        [hessian],
        ["x", "p", "lam_f", "lam_g"],
        ["triu_hess_gamma_x_x"],
    )
