"""The structured quadratic program of one Gauss-Newton step: banded KKT system, active bounds by semismooth Newton.

The unknowns of slot k are ordered [dx_k, dw_k, nu_k, lambda_k, mu_k]: states, disturbance, multipliers of output
bounds, of the dynamics and of the sharing of w inside a cell. In this order the KKT matrix is banded, and LAPACK
factorises it with partial pivoting in O(N). Constant parameters are a border, eliminated by a small Schur complement.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

import numpy as np

from ctmhe.types import Array


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """Minimise g'v + v'Hv/2 subject to linearised dynamics and boxes, in scaled variables.

    Shapes: N slots, `Hxx (N, nx, nx)`, `Hxw (N, nx, nw)`, `Hww (N, nw, nw)`, `Hxp (N, nx, np)`, `Hwp (N, nw, np)`,
    `Hpp (np, np)`, `gx (N+1, nx)`, `gw (N, nw)`, `gp (np,)`; dynamics A dx_k + B dw_k + E dp - dx_{k+1} = -c; outputs
    C dx_k + D dw_k + F dp between y_lower and y_upper (all relative to the current point); `shared (N,)` ties
    dw_{k+1} = dw_k.
    """

    Hxx: Array
    Hxw: Array
    Hww: Array
    Hxp: Array
    Hwp: Array
    Hpp: Array
    gx: Array
    gw: Array
    gp: Array
    A: Array
    B: Array
    E: Array
    c: Array
    C: Array
    D: Array
    F: Array
    x_lower: Array
    x_upper: Array
    w_lower: Array
    w_upper: Array
    y_lower: Array
    y_upper: Array
    p_lower: Array
    p_upper: Array
    shared: np.ndarray


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """Which bounds are held: -1 lower, 0 none, +1 upper."""

    x: np.ndarray
    w: np.ndarray
    y: np.ndarray
    p: np.ndarray

    def key(self) -> bytes:
        """Return the set as bytes, to recognise one seen before."""
        return b"".join(part.tobytes() for part in (self.x, self.w, self.y, self.p))


@dataclass(frozen=True, eq=False)
class Step:
    """The minimiser of a quadratic program and its multipliers."""

    dx: Array
    dw: Array
    dp: Array
    dynamics: Array
    zx: Array
    zw: Array
    zy: Array
    zp: Array
    active: ActiveSet
    factorizations: int


class Singular(ArithmeticError):
    """The KKT matrix has no usable factorisation: a direction without curvature, or dependent active bounds."""


class _Layout:
    """Where each block of a slot stands in LAPACK's band storage; depends on sizes only."""

    def __init__(self, nx: int, nw: int, ny: int, shared: bool):
        self.nx, self.nw, self.ny, self.nm = nx, nw, ny, nw if shared else 0
        offsets = np.cumsum([0, nx, nw, ny, nx, self.nm])
        self.ox, self.ow, self.oy, self.ol, self.om, self.size = offsets
        r = {
            key: offsets[i] + np.arange(n)
            for i, (key, n) in enumerate(zip("xwylm", (nx, nw, ny, nx, self.nm), strict=True))
        }
        r["X"], r["W"] = self.size + r["x"], self.size + r["w"]  # the next slot's
        pairs = ["xx", "xw", "wx", "ww", "xy", "wy", "yx", "yw", "yy", "xl", "wl", "lx", "lw", "lX", "Xl"]
        if shared:
            pairs += ["wm", "mw", "mW", "Wm", "mm"]
        spread = [abs(int(i) - int(j)) for a, b in pairs for i in r[a] for j in r[b]]
        self.band = max(spread, default=0)
        self.rows = 3 * self.band + 1
        self.at = {a + b: self._flat(r[a], r[b]) for a, b in pairs}
        self.diagonal = {key: self._flat_pairs(r[key], r[key]) for key in r}
        self.eye = {"lX": self._flat_pairs(r["l"], r["X"]), "Xl": self._flat_pairs(r["X"], r["l"])}
        if shared:
            for a, b in (("w", "m"), ("m", "w"), ("m", "W"), ("W", "m")):
                self.eye[a + b] = self._flat_pairs(r[a], r[b])

    def _flat_pairs(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return 2 * self.band + i - j + j * self.rows

    def _flat(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return self._flat_pairs(i[:, None], j[None, :]).reshape(-1)


class KKT:
    """Solves quadratic programs of one problem size; band storage is reused from call to call.

    Parameters
    ----------
    nx, nw, ny, np : int
        Sizes; `ny` is 0 when outputs are not bounded.
    """

    def __init__(self, nx: int, nw: int, ny: int, n_parameters: int):
        self.nx, self.nw, self.ny, self.np = nx, nw, ny, n_parameters
        self._layouts = {shared: _Layout(nx, nw, ny, shared) for shared in (False, True)}
        self._storage = np.empty(0)
        lapack = import_module("scipy.linalg.lapack")  # late: it takes as long to import as CasADi
        self._factor, self._solve = lapack.dgbtrf, lapack.dgbtrs

    def solve(self, qp: QuadraticProgram, active: ActiveSet, *, damping: float = 0.0, max_changes: int = 40) -> Step:
        """Return the minimiser, starting from a guess of the active set.

        The primal-dual active set method (a semismooth Newton method): each pass solves the equality-constrained
        problem, then drops held bounds whose multiplier has the wrong sign and holds violated ones. When a set comes
        back, or holds bounds that depend on each other, only the single worst change is made from then on.

        Raises
        ------
        Singular
            If the KKT matrix cannot be factorised, or no consistent set was found in `max_changes` passes.
        """
        seen: set[bytes] = set()
        single, cautious = False, None  # cautious: the single worst change to the last set that could be factorised
        for attempt in range(max_changes):
            try:
                step = self._equality_constrained(qp, active, damping)
            except Singular:
                if single or cautious is None:
                    raise
                single, active = True, cautious
                continue
            candidate, worst = self._update(qp, step, active)
            if candidate is None:
                return Step(
                    step.dx, step.dw, step.dp, step.dynamics, step.zx, step.zw, step.zy, step.zp, active, attempt + 1
                )
            key = candidate.key()
            single = single or key in seen
            seen.add(key)
            cautious = worst
            active = worst if single else candidate
        raise Singular(f"no consistent set of active bounds in {max_changes} passes")

    def _update(self, qp: QuadraticProgram, step: Step, active: ActiveSet) -> tuple[ActiveSet | None, ActiveSet]:
        dy = np.einsum("kij,kj->ki", qp.C, step.dx[:-1]) + np.einsum("kij,kj->ki", qp.D, step.dw) + qp.F @ step.dp
        groups = (
            (step.dx, qp.x_lower, qp.x_upper, step.zx, active.x),
            (step.dw, qp.w_lower, qp.w_upper, step.zw, active.w),
            (dy, qp.y_lower, qp.y_upper, step.zy, active.y),
            (step.dp, qp.p_lower, qp.p_upper, step.zp, active.p),
        )
        size = max((float(np.abs(z).max(initial=0.0)) for _, _, _, z, _ in groups), default=0.0)
        new, worst = [], (0.0, -1, 0, 0)
        changed = False
        for g, (value, lower, upper, z, held) in enumerate(groups):
            fixed = lower == upper
            low, high = lower - value, value - upper
            target = np.where(fixed, 1, 0).astype(np.int8)
            keep = (held != 0) & ~fixed & (held * z > -1e-9 * size)
            target[keep] = held[keep]
            free = (held == 0) & ~fixed
            target[free & (low > 1e-10)] = -1
            target[free & (high > 1e-10)] = 1
            difference = target != held
            if difference.any():
                changed = True
                badness = np.where(held != 0, -held * z / max(size, 1e-300), np.maximum(low, high))
                badness = np.where(difference, np.where(fixed, np.inf, badness), -np.inf)
                flat = int(np.argmax(badness))
                if badness.flat[flat] > worst[0] or worst[1] < 0:
                    worst = (float(badness.flat[flat]), g, flat, int(target.flat[flat]))
            new.append(target)
        if not changed:
            return None, active
        one = [part.copy() for part in (active.x, active.w, active.y, active.p)]
        one[worst[1]].flat[worst[2]] = worst[3]
        return ActiveSet(*new), ActiveSet(*one)

    def end_covariance(self, qp: QuadraticProgram, damping: float) -> Array:
        """Return the block of the inverse KKT matrix that belongs to (dx_N, dp), bounds ignored."""
        n, nx, npar = len(qp.A), self.nx, self.np
        none = ActiveSet(*(np.zeros(shape, np.int8) for shape in ((n + 1, nx), (n, self.nw), (n, self.ny), (npar,))))
        factors, layout, pivots = self._factorize(qp, none, damping)
        border = self._right_hand_side(qp, none, layout)[:, 1:]
        unit = np.zeros((len(border), nx))
        unit[-nx:] = np.eye(nx)
        solution = self._back_substitute(factors, layout, pivots, np.asfortranarray(np.hstack([unit, border])))
        covariance = solution[-nx:, :nx]
        if npar:
            columns = solution[:, nx:]
            schur = qp.Hpp + damping * np.eye(npar) - border.T @ columns
            try:
                inverse = np.linalg.inv(schur)
            except np.linalg.LinAlgError:
                raise Singular("the parameters are not determined") from None
            tail = columns[-nx:]
            covariance = covariance + tail @ inverse @ tail.T
            covariance = np.block([[covariance, -tail @ inverse], [-inverse @ tail.T, inverse]])
        return covariance

    def _factorize(self, qp: QuadraticProgram, active: ActiveSet, damping: float) -> tuple[Array, _Layout, Array]:
        n, nx, nw, ny = len(qp.A), self.nx, self.nw, self.ny
        layout = self._layouts[bool(qp.shared.any())]
        b, rows = layout.size, layout.rows
        total = n * b + nx
        length = (n + 2) * b * rows
        if len(self._storage) < length:
            self._storage = np.empty(2 * length)
        flat = self._storage[:length]
        flat[:] = 0.0
        blocks = flat[: n * b * rows].reshape(n, b * rows)
        following = flat[b * rows : (n + 1) * b * rows].reshape(n, b * rows)
        at, diagonal, eye = layout.at, layout.diagonal, layout.eye
        free_x, free_w = (active.x == 0).astype(float), (active.w == 0).astype(float)
        held_y = (active.y != 0).astype(float)

        rows_x, rows_w = free_x[:-1, :, None], free_w[:, :, None]
        blocks[:, at["xx"]] = (qp.Hxx * rows_x).reshape(n, -1)
        blocks[:, at["xw"]] = (qp.Hxw * rows_x).reshape(n, -1)
        blocks[:, at["wx"]] = (qp.Hxw.transpose(0, 2, 1) * rows_w).reshape(n, -1)
        blocks[:, at["ww"]] = (qp.Hww * rows_w).reshape(n, -1)
        blocks[:, diagonal["x"]] += np.where(active.x[:-1] == 0, damping, 1.0)
        blocks[:, diagonal["w"]] += np.where(active.w == 0, damping, 1.0)
        last = flat[n * b * rows :]
        last[diagonal["x"]] += np.where(active.x[-1] == 0, damping, 1.0)
        blocks[:, at["xl"]] = (qp.A.transpose(0, 2, 1) * rows_x).reshape(n, -1)
        blocks[:, at["wl"]] = (qp.B.transpose(0, 2, 1) * rows_w).reshape(n, -1)
        blocks[:, at["lx"]] = qp.A.reshape(n, -1)
        blocks[:, at["lw"]] = qp.B.reshape(n, -1)
        following_eye = eye["lX"] - b * rows
        following[:, following_eye] = -1.0
        blocks[:, eye["Xl"]] = -free_x[1:]
        if ny:
            blocks[:, at["xy"]] = (qp.C.transpose(0, 2, 1) * rows_x).reshape(n, -1)
            blocks[:, at["wy"]] = (qp.D.transpose(0, 2, 1) * rows_w).reshape(n, -1)
            blocks[:, at["yx"]] = (qp.C * held_y[:, :, None]).reshape(n, -1)
            blocks[:, at["yw"]] = (qp.D * held_y[:, :, None]).reshape(n, -1)
            blocks[:, diagonal["y"]] = 1.0 - held_y
        if layout.nm:
            tied = qp.shared.astype(float)[:, None]
            next_free = np.vstack([free_w[1:], np.zeros((1, nw))])
            blocks[:, eye["mw"]] = -tied
            blocks[:, eye["wm"]] = -tied * free_w
            following[:-1, eye["mW"] - b * rows] = tied[:-1]
            blocks[:, eye["Wm"]] = tied * next_free
            blocks[:, diagonal["m"]] = 1.0 - tied
        band = np.ndarray((rows, total), buffer=flat.data, order="F")
        factors, pivots, info = self._factor(band, layout.band, layout.band, overwrite_ab=1)
        if info != 0:
            raise Singular("the KKT matrix is singular")
        return factors, layout, pivots

    def _right_hand_side(self, qp: QuadraticProgram, active: ActiveSet, layout: _Layout) -> Array:
        """Return the negative gradients (or the bounds held), and behind them the border of the parameters."""
        n, nx, nw, ny, npar, b = len(qp.A), self.nx, self.nw, self.ny, self.np, layout.size
        rhs = np.zeros((n * b + nx, 1 + npar), order="F")
        slots = rhs[: n * b].reshape(n, b, 1 + npar)
        target_x = np.where(active.x < 0, qp.x_lower, qp.x_upper)
        target_w = np.where(active.w < 0, qp.w_lower, qp.w_upper)
        slots[:, layout.ox : layout.ox + nx, 0] = np.where(active.x[:-1] == 0, -qp.gx[:-1], target_x[:-1])
        slots[:, layout.ow : layout.ow + nw, 0] = np.where(active.w == 0, -qp.gw, target_w)
        slots[:, layout.ol : layout.ol + nx, 0] = -qp.c
        rhs[n * b :, 0] = np.where(active.x[-1] == 0, -qp.gx[-1], target_x[-1])
        if ny:
            target_y = np.where(active.y < 0, qp.y_lower, qp.y_upper)
            slots[:, layout.oy : layout.oy + ny, 0] = np.where(active.y == 0, 0.0, target_y)
        if npar:
            slots[:, layout.ox : layout.ox + nx, 1:] = qp.Hxp * (active.x[:-1, :, None] == 0)
            slots[:, layout.ow : layout.ow + nw, 1:] = qp.Hwp * (active.w[:, :, None] == 0)
            slots[:, layout.ol : layout.ol + nx, 1:] = qp.E
            if ny:
                slots[:, layout.oy : layout.oy + ny, 1:] = qp.F * (active.y[:, :, None] != 0)
        return rhs

    def _back_substitute(self, factors: Array, layout: _Layout, pivots: Array, rhs: Array) -> Array:
        solution, info = self._solve(factors, layout.band, layout.band, rhs, pivots)
        if info != 0 or not np.isfinite(solution).all():
            raise Singular("the KKT matrix is singular")
        return solution

    def _equality_constrained(self, qp: QuadraticProgram, active: ActiveSet, damping: float) -> Step:
        factors, layout, pivots = self._factorize(qp, active, damping)
        n, b, nx, nw, ny, npar = len(qp.A), layout.size, self.nx, self.nw, self.ny, self.np
        solution = self._back_substitute(factors, layout, pivots, self._right_hand_side(qp, active, layout))
        v = np.ascontiguousarray(solution[:, 0])
        dp = np.zeros(npar)
        if npar:
            dp = self._parameters(qp, layout, active, damping, solution)
            v = v - solution[:, 1:] @ dp
        parts = v[: n * b].reshape(n, b)
        dx = np.vstack([parts[:, layout.ox : layout.ox + nx], v[n * b :][None, :]])
        dw = np.ascontiguousarray(parts[:, layout.ow : layout.ow + nw])
        zy = np.ascontiguousarray(parts[:, layout.oy : layout.oy + ny])
        dynamics = np.ascontiguousarray(parts[:, layout.ol : layout.ol + nx])
        mu = parts[:, layout.om : layout.om + layout.nm]
        return self._with_bound_multipliers(qp, active, dx, dw, dp, dynamics, zy, mu)

    def _parameters(
        self, qp: QuadraticProgram, layout: _Layout, active: ActiveSet, damping: float, solution: Array
    ) -> Array:
        n, b, npar = len(qp.A), layout.size, self.np
        columns = solution[: n * b].reshape(n, b, 1 + npar)
        total = np.zeros((npar, 1 + npar))
        for block, offset, width in (
            (qp.Hxp, layout.ox, self.nx),
            (qp.Hwp, layout.ow, self.nw),
            (qp.E, layout.ol, self.nx),
        ):
            total += np.einsum("kip,kij->pj", block, columns[:, offset : offset + width])
        if self.ny:
            total += np.einsum("kip,kij->pj", qp.F, columns[:, layout.oy : layout.oy + self.ny])
        matrix = qp.Hpp + damping * np.eye(npar) - total[:, 1:]
        rhs = -qp.gp - total[:, 0]
        for i in np.flatnonzero(active.p):
            matrix[i] = 0.0
            matrix[i, i] = 1.0
            rhs[i] = qp.p_lower[i] if active.p[i] < 0 else qp.p_upper[i]
        try:
            return np.linalg.solve(matrix, rhs)
        except np.linalg.LinAlgError:
            raise Singular("the parameters are not determined") from None

    def _with_bound_multipliers(
        self,
        qp: QuadraticProgram,
        active: ActiveSet,
        dx: Array,
        dw: Array,
        dp: Array,
        dynamics: Array,
        zy: Array,
        mu: Array,
    ) -> Step:
        x, w = dx[:-1, :, None], dw[:, :, None]
        rx = qp.gx.copy()
        rx[:-1] += (qp.Hxx @ x + qp.Hxw @ w)[..., 0] + qp.Hxp @ dp
        rx[:-1] += (qp.A.transpose(0, 2, 1) @ dynamics[:, :, None])[..., 0]
        rx[1:] -= dynamics
        rw = qp.gw + (qp.Hxw.transpose(0, 2, 1) @ x + qp.Hww @ w)[..., 0] + qp.Hwp @ dp
        rw += (qp.B.transpose(0, 2, 1) @ dynamics[:, :, None])[..., 0]
        rp = qp.gp + qp.Hpp @ dp
        rp = rp + np.einsum("kip,ki->p", qp.Hxp, dx[:-1]) + np.einsum("kip,ki->p", qp.Hwp, dw)
        rp = rp + np.einsum("kip,ki->p", qp.E, dynamics)
        if self.ny:
            rx[:-1] += (qp.C.transpose(0, 2, 1) @ zy[:, :, None])[..., 0]
            rw += (qp.D.transpose(0, 2, 1) @ zy[:, :, None])[..., 0]
            rp = rp + np.einsum("kip,ki->p", qp.F, zy)
        if mu.shape[1]:
            tied = qp.shared[:, None] * mu
            rw -= tied
            rw[1:] += tied[:-1]
        zx, zw = np.where(active.x != 0, -rx, 0.0), np.where(active.w != 0, -rw, 0.0)
        zp = np.where(active.p != 0, -rp, 0.0)
        return Step(dx, dw, dp, dynamics, zx, zw, np.where(active.y != 0, zy, 0.0), zp, active, 1)
