"""The sensitivity equations of a model without expressions (an FMU), for an integrator with error control."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.models.continuous import Model

NO_AD = {"enable_forward": False, "enable_reverse": False}  # derivatives come from the Jacobian that is given
STEP = ("t", "h", "x", "w", "p", "u0", "u1")

Flow = Callable[[dict[str, Any], Sequence[float]], ca.Function]


def step_symbols(model: Model, kind: Any) -> list[Any]:
    """Return the symbols (t, h, x, w, p, u0, u1) of a step."""
    sizes = {"t": 1, "h": 1, "x": len(model.x), "w": len(model.w), "p": len(model.p)}
    sizes |= {"u0": len(model.u), "u1": len(model.u)}
    return [kind.sym(name, sizes[name]) for name in STEP]


def step_with_sensitivities(model: Model, grid: Sequence[float], flow: Flow) -> ca.Function:
    """Return the step (t, h, x, w, p, u0, u1) -> (x_next, y) and its Jacobian by (x, w, p).

    Forward sensitivities of CasADi ask for second derivatives, for Newton's method. Here x and S = dx/d(x0, w, p)
    are one system, dS/dt = f_x S + [0 f_w f_p], and Newton's matrix has f_x in every block of its diagonal, which is
    what CVODES does with sensitivities of its own. All is scaled by the signals' nominals.

    Parameters
    ----------
    model : Model
    grid : sequence of float
        Where outputs are wanted, in steps; the last is 1.
    flow : callable (problem, grid) -> casadi.Function
        Makes an integrator over s in [0, 1].
    """
    nx, nw, n_p = len(model.x), len(model.w), len(model.p)
    n = nx + nw + n_p
    sizes = [ca.DM(np.asarray(signals.nominal)) for signals in (model.x, model.w, model.p)]
    scale, columns = sizes[0], ca.vertcat(*sizes)
    f_jacobian, h_jacobian = model.dynamics.jacobian(), model.output.jacobian()

    def integrator(many: int) -> ca.Function:
        """Return the integrator of x / scale and `many` scaled columns of S."""
        z, s, q = ca.MX.sym("z", nx * (1 + many)), ca.MX.sym("s"), ca.MX.sym("q", 2 + nw + n_p + 2 * len(model.u))
        t, h, w, p, u0, u1 = ca.vertsplit(q, np.cumsum([0, 1, 1, nw, n_p, len(model.u), len(model.u)]).tolist())
        here = t + s * h, z[:nx] * scale, u0 + s * (u1 - u0), w, p
        f = model.dynamics(*here)
        _, f_x, _, f_w, f_p = f_jacobian(*here, f)
        newton = h * _scaled(f_x, scale, scale)
        rate = h * f / scale
        if many:
            direct = _scaled(ca.horzcat(ca.MX(nx, nx), f_w, f_p), scale, columns)
            rate = ca.vertcat(rate, ca.vec(newton @ ca.reshape(z[nx:], nx, many) + h * direct))
        result, size = ca.MX.sym("out_rate", rate.numel()), rate.numel()
        blocks = [ca.diagcat(*[newton] * (1 + many)), ca.MX(size, 1), ca.MX(size, q.numel())]
        labels = [f"jac_rate_{key}" for key in "zsq"]
        jacobian = ca.Function("jac_rates", [z, s, q, result], blocks, ["z", "s", "q", "out_rate"], labels)
        options: dict[str, Any] = {"custom_jacobian": jacobian, "never_inline": True, **NO_AD}
        rates = ca.Function("rates", [z, s, q], [rate], ["z", "s", "q"], ["rate"], options)
        return flow({"x": z, "t": s, "p": q, "ode": rates(z, s, q)}, grid)

    symbols = step_symbols(model, ca.MX)
    t, h, x, w, p, u0, u1 = symbols
    given = ca.vertcat(t, h, w, p, u0, u1)

    def at(c: float, state: ca.MX) -> tuple[ca.MX, ...]:
        return t + c * h, state * scale, u0 + c * (u1 - u0), w, p

    states = integrator(0)(x0=x / scale, p=given)["xf"]
    y = [model.output(*at(c, states[:, i])) for i, c in enumerate(grid)]
    start = ca.vertcat(x / scale, ca.vec(ca.DM.eye(nx)), ca.DM.zeros(nx * (nw + n_p)))
    both = integrator(n)(x0=start, p=given)["xf"]
    rows, S = [], ca.MX(nx, n)
    for i, c in enumerate(grid):
        here = at(c, both[:nx, i])
        S = _scaled(ca.reshape(both[nx:, i], nx, n), 1 / scale, 1 / columns)
        _, h_x, _, h_w, h_p = h_jacobian(*here, model.output(*here))
        rows.append(h_x @ S + ca.horzcat(ca.MX(len(model.y), nx), h_w, h_p))
    return _with_jacobian(symbols, [states[:, -1] * scale, ca.horzcat(*y)], [S, ca.vertcat(*rows)], [nx, nw, n_p])


def _scaled(matrix: ca.MX, rows: ca.DM, columns: ca.DM) -> ca.MX:
    """Return the derivatives of signals / rows by signals / columns."""
    return ca.diag(1 / rows) @ matrix @ ca.diag(columns)


def _with_jacobian(symbols: list[ca.MX], results: list[ca.MX], by_all: list[ca.MX], sizes: list[int]) -> ca.Function:
    """Return the step; `by_all` are the derivatives of the results by (x, w, p), the only ones that are ever asked."""
    taken = [ca.MX.sym(f"out_{name}", *value.shape) for name, value in zip(("x_next", "y"), results, strict=True)]
    blocks, labels = [], []
    for name, value, derivative in zip(("x_next", "y"), results, by_all, strict=True):
        parts = dict(zip("xwp", ca.horzsplit(derivative, np.cumsum([0, *sizes]).tolist()), strict=True))
        for key, symbol in zip(STEP, symbols, strict=True):
            blocks.append(parts.get(key, ca.MX(value.numel(), symbol.numel())))
            labels.append(f"jac_{name}_{key}")
    jacobian = ca.Function("jac_step", [*symbols, *taken], blocks, [*STEP, "out_x_next", "out_y"], labels)
    options: dict[str, Any] = {"custom_jacobian": jacobian, "never_inline": True, **NO_AD}
    return ca.Function("step", symbols, results, list(STEP), ["x_next", "y"], options)
