"""States for given mixing weights, weights for given states, in turn: the dual iterations (10)-(11) of paper 003."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.solvers.base import Solution, Solver
from ctmhe.transcription.integrators import is_symbolic
from ctmhe.transcription.problem import Guess, Window, bound_violation, cost_of
from ctmhe.transcription.stage import StageFunction
from ctmhe.transcription.weights import square_root
from ctmhe.types import Array, Outcome, positive


@dataclass(frozen=True)
class DualIterations:
    """Solve a polytope's joint problem (6) by turns: `MHE(polytope, ..., solver=DualIterations(10))`.

    (10) finds states and disturbances for given weights, by Gauss-Newton in the core, bounds included; (11) the weights
    on the simplex for given states at the edges of cells, where the disturbance makes up for what the mixture does not
    say. Both decrease the same cost, so every iteration does, and what they converge to solves (6) in each direction
    alone. The weights are constant over the window.

    Parameters
    ----------
    iterations : int
        How often, at most: l of the paper. See `dual_iterations` for (33).
    tolerance : float
        Relative decrease of the cost in an iteration below which they have converged.
    misfit : float, optional
        Cost for each number measured above which a window is noted as one that no mixture explains. With weights that
        are inverse covariances about 1 is expected.
    """

    iterations: int = 10
    tolerance: float = 1e-9
    misfit: float = np.inf

    def __post_init__(self) -> None:
        if isinstance(self.iterations, bool) or not isinstance(self.iterations, int) or self.iterations < 1:
            raise InputError(f"DualIterations: iterations must be a positive integer, got {self.iterations!r}")
        positive("DualIterations: tolerance", self.tolerance)
        if not self.misfit > 0:
            raise InputError(f"DualIterations: misfit must be positive, got {self.misfit!r}")

    def on(self, stage: StageFunction, inner: Solver) -> Solver:
        """Return the solver for a model, with `inner` for the states; raise `InputError` for other models."""
        model = stage.model
        if stage.nw != stage.nx:
            raise InputError(
                f"DualIterations: model {model.name!r} needs one disturbance on every state, as `polytope` makes it"
            )
        return _Turns(stage, inner, self)


class _Turns:
    """`DualIterations` on one model."""

    name = "dual iterations"

    def __init__(self, stage: StageFunction, inner: Solver, rule: DualIterations):
        self.stage, self.inner, self.rule = stage, inner, rule
        self.affine = stage.model.step is not None and _is_affine(stage)

    def solve(self, window: Window, guess: Guess) -> Solution:
        """Return where the iterations end: a trajectory of the mixture whose weights it carries."""
        nx, notes = self.stage.nx, ()
        mixed = window.p_estimated and self.stage.np > 0
        if mixed:
            alpha, moved = _projected(guess.p)
            prior, off = _projected(window.prior[nx:])
            window = replace(window, prior=np.concatenate([window.prior[:nx], prior]))
            guess = replace(guess, p=alpha)
            if moved or off:
                notes = ("mixing weights off the simplex: projected onto it",)
        P = window.L_prior.T @ window.L_prior
        split = square_root(P[:nx, :nx]), np.linalg.pinv(P[:nx, :nx], hermitian=True) @ P[:nx, nx:]
        solution = self._states(window, split, guess)
        before, count, last = solution.cost, 0, False
        cells = np.concatenate([[0], np.cumsum(~window.mesh.shared[:-1])])
        while mixed and solution.success and count < self.rule.iterations:
            count += 1
            point, y, total = self._weights(window, cells, solution)
            last = before - total <= self.rule.tolerance * before
            before, solution = total, replace(solution, point=point, y=y, cost=total)
            if last or count == self.rule.iterations:
                break
            solution = self._states(window, split, point)
        if not solution.success:
            return solution
        known = int(np.count_nonzero(np.diagonal(window.L_y, axis1=2, axis2=3)))
        if known and solution.cost > self.rule.misfit * known:
            said = f"cost {solution.cost:.3g} for {known} numbers; widen the polytope or lower Q and R"
            notes += (f"no mixture explains the window: {said}",)
        converged = last or not mixed
        message = "converged" if converged else f"{count} dual iterations"
        stopped = None if converged else Outcome.ITERATION_LIMIT
        return replace(solution, iterations=count, message=message, success=converged, stopped=stopped, notes=notes)

    def _states(self, window: Window, split: tuple[Array, Array], guess: Guess) -> Solution:
        """Solve (10): states and disturbances for the weights of `guess`; `split` is what the prior says of states."""
        if not window.p_estimated:
            return self.inner.solve(window, guess)
        nx, (root, coupling) = self.stage.nx, split
        prior = np.concatenate([window.prior[:nx] - coupling @ (guess.p - window.prior[nx:]), guess.p])
        known = replace(window, p_estimated=False, prior=prior, L_prior=root)
        solution = self.inner.solve(known, guess)
        return replace(solution, cost=cost_of(window, solution.point, solution.y))

    def _weights(self, window: Window, cells: np.ndarray, solution: Solution) -> tuple[Guess, Array, float]:
        """Solve (11): weights for given states at the edges of cells. Return point, outputs and cost, never larger."""
        point = solution.point
        found, r, J, by_alpha = self._followed(window, point, cells, point.p)
        before = cost_of(window, *found)
        allowed = max(1e-9, bound_violation(window, found[0], found[1][:, -1]))
        move = simplex_least_squares(J, J @ point.p - r) - point.p
        for share in 0.5 ** np.arange(30):  # where the model is affine in the weights the whole move is best
            step = share * move
            if self.affine:
                guess, y = found
                w = guess.w + (by_alpha[0] @ step[:, None])[..., 0]
                trial = replace(guess, w=w, p=guess.p + step), y + (by_alpha[1] @ step[:, None])[..., 0]
            else:
                try:
                    trial = self._followed(window, point, cells, point.p + step)[0]
                except FloatingPointError:
                    continue
            total = cost_of(window, *trial)
            if total <= before and bound_violation(window, trial[0], trial[1][:, -1]) <= allowed:
                return trial[0], trial[1], total
        return found[0], found[1], before

    def _followed(
        self, window: Window, point: Guess, cells: np.ndarray, alpha: Array
    ) -> tuple[tuple[Guess, Array], Array, Array, tuple[Array, Array]]:
        """Return the trajectory of some weights through the states at the edges of cells, residuals and Jacobian.

        Last come the derivatives of w and y by the weights. The disturbance of a cell is what leads to its end: the
        model is linear in it. `cells` (N,) numbers them.
        """
        stage, mesh, n = self.stage, window.mesh, len(window.mesh)
        nx, nw, q = stage.nx, stage.nw, stage.np
        count = int(cells[-1]) + 1
        first = np.searchsorted(cells, np.arange(count))
        last = np.searchsorted(cells, np.arange(count), side="right") - 1
        x, w, y = point.x.copy(), point.w.copy(), np.empty((n, stage.q, stage.ny))
        by_w, by_alpha = np.zeros((count, nx, nw)), np.zeros((count, nx, q))
        x_w, y_w, y_alpha = np.zeros((n, nx, nw)), np.zeros((*y.shape, nw)), np.zeros((*y.shape, q))
        rank = np.arange(n) - first[cells]
        for r in range(int(rank.max()) + 1):  # the slots of a cell one after the other, those of all cells at once
            k = np.flatnonzero(rank == r)
            c = cells[k]
            found = stage.linearize(mesh.t[k], mesh.h[k], x[k], w[k], alpha, window.u0[k], window.u1[k])
            J_x, J_w, J_alpha = np.split(found.jacobian[:, :nx], [nx, nx + nw], axis=2)
            rows = found.jacobian[:, nx:].reshape(len(k), stage.q, stage.ny, -1)
            Y_x, Y_w, Y_alpha = np.split(rows, [nx, nx + nw], axis=3)
            y[k] = found.y
            y_w[k] = Y_x @ by_w[c][:, None] + Y_w
            y_alpha[k] = Y_x @ by_alpha[c][:, None] + Y_alpha
            by_w[c], by_alpha[c] = J_x @ by_w[c] + J_w, J_x @ by_alpha[c] + J_alpha
            x_w[k] = by_w[c]
            x[k + 1] = found.x_next
        moves = np.add.reduceat(mesh.h, first) > 0
        dw, w_alpha = np.zeros((count, nw)), np.zeros((count, nw, q))
        gap = point.x[last + 1] - x[last + 1]
        dw[moves] = np.linalg.solve(by_w[moves], gap[moves][..., None])[..., 0]
        w_alpha[moves] = -np.linalg.solve(by_w[moves], by_alpha[moves])
        w += dw[cells]
        x[1:] += (x_w @ dw[cells][..., None])[..., 0]
        x[first] = point.x[first]
        y += (y_w @ dw[cells][:, None, :, None])[..., 0]
        y_alpha += y_w @ w_alpha[cells][:, None]
        deviation = np.concatenate([x[0], alpha]) - window.prior
        residuals = (
            window.L_prior @ deviation,
            window.L_w @ w[..., None],
            window.L_y @ (y - window.y_data)[..., None],
        )
        rows = (window.L_prior[:, nx:], window.L_w @ w_alpha[cells], window.L_y @ y_alpha)
        r, J = (np.concatenate([part.reshape(-1, m) for part in parts]) for parts, m in ((residuals, 1), (rows, q)))
        active = (point.x_active, point.w_active, point.y_active, point.p_active)
        return (Guess(x, w, alpha, *active), y), r[:, 0], J, (w_alpha[cells], y_alpha)


def simplex_least_squares(J: Array, b: Array) -> Array:
    """Return the a >= 0 with sum 1 that minimises |J a - b|.

    On the simplex J a - b = D a with D = J - b 1'. The minimiser of |D a|^2 + (1'a - 1)^2 over a >= 0 is a multiple of
    the one sought, whatever the size of D: along a ray the best multiple costs f / (1 + f), which grows with f.
    """
    from scipy.optimize import nnls  # of SciPy only what is needed, when it is

    D = J - b[:, None]
    D = D / max(float(np.linalg.norm(D)), 1e-300)
    a, _ = nnls(np.vstack([D, np.ones(D.shape[1])]), np.append(np.zeros(len(D)), 1.0))
    return a / a.sum()


def _is_affine(stage: StageFunction) -> bool:
    """Return whether steps and outputs are affine in the parameters for given states."""
    model = stage.model
    if not is_symbolic(model):
        return False
    symbols = [ca.SX.sym(name, model.output.size1_in(i)) for i, name in enumerate("txuwp")]
    both = ca.vertcat(model.dynamics(*symbols), model.output(*symbols))
    return not any(ca.which_depends(both, symbols[4], 2, False)) if stage.np else True


def _projected(alpha: Array) -> tuple[Array, bool]:
    """Return the nearest point of the simplex, and whether that is another one than `alpha`."""
    ordered = np.sort(alpha)[::-1]
    excess = (np.cumsum(ordered) - 1) / np.arange(1, len(alpha) + 1)
    shift = excess[np.flatnonzero(ordered > excess)[-1]]
    nearest = np.maximum(alpha - shift, 0.0)
    return nearest, bool(np.abs(nearest - alpha).max() > 1e-6)
