"""An FMU as CasADi functions of (t, x, u, w, p), for what does not call its evaluator directly: CVODES, IPOPT."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.models.continuous import ARGUMENTS
from ctmhe.models.fmu.evaluators import Evaluators
from ctmhe.types import Array

# Every derivative is taken from one Jacobian.
NO_AD = {"enable_forward": False, "enable_reverse": False}
REACH = float(np.cbrt(np.finfo(float).eps))  # relative step of central differences


class FmuFunctions:
    """Makes `dynamics` and `output` of a model.

    Parameters
    ----------
    evaluators : Evaluators
        Each thread's own is asked.
    sizes : sequence of int
        nx, nu, nw, np, ny.
    u_nominal : array (nu,)
        Typical magnitudes: derivatives with respect to u and t are central differences.
    """

    def __init__(self, evaluators: Evaluators, sizes: Sequence[int], u_nominal: Array):
        nx, nu, nw, n_p, ny = sizes
        self._evaluators, self._u_nominal = evaluators, u_nominal
        self._sizes = {"t": 1, "x": nx, "u": nu, "w": nw, "p": n_p}
        self._kept: list[ca.Callback] = []  # CasADi holds no reference to a callback
        self.dynamics = self._function("f", nx, lambda dx, _: dx, slice(0, nx))
        self.output = self._function("h", ny, lambda _, y: y, slice(nx, nx + ny))

    def _function(self, name: str, rows: int, part: Callable[[Array, Array], Array], which: slice) -> ca.Function:
        evaluators, (nx, nw) = self._evaluators, (self._sizes["x"], self._sizes["w"])

        def value(t: Array, x: Array, u: Array, w: Array, p: Array) -> Array:
            return part(*evaluators.mine().evaluate(t[0], x, u, w, p, jacobian=False)[:2])

        def by_t(t: Array, *rest: Array) -> Array:
            step = REACH * max(1.0, abs(t[0]))
            return ((value(t + step, *rest) - value(t - step, *rest)) / (2 * step))[:, None]

        def by_u(t: Array, x: Array, u: Array, w: Array, p: Array) -> Array:
            columns = np.zeros((rows, len(u)))
            for j, size in enumerate(self._u_nominal):
                step = np.zeros(len(u))
                step[j] = REACH * max(size, abs(u[j]))
                columns[:, j] = (value(t, x, u + step, w, p) - value(t, x, u - step, w, p)) / (2 * step[j])
            return columns

        def jacobian(results: Sequence[Array | None], *point: Array) -> None:
            if any(results[i] is not None for i in (1, 3, 4)):
                J = evaluators.mine().evaluate(point[0][0], *point[1:])[2][which]
                for i, columns in ((1, slice(0, nx)), (3, slice(nx, nx + nw)), (4, slice(nx + nw, None))):
                    _fill(results[i], J[:, columns])
            if results[0] is not None:
                _fill(results[0], by_t(*point))
            if results[2] is not None:
                _fill(results[2], by_u(*point))

        sizes = list(self._sizes.values())
        run = _Callback(f"{name}_fmu", sizes, [(rows, 1)], lambda results, *point: _fill(results[0], value(*point)))
        shapes = [(rows, size) for size in sizes]
        derive = _Callback(
            f"jac_{name}_fmu", [*sizes, rows], shapes, lambda results, *point: jacobian(results, *point[:5])
        )
        self._kept += [run, derive]
        symbols = [ca.MX.sym(key, size) for key, size in self._sizes.items()]
        names = [*ARGUMENTS, "out_value"]
        result = ca.MX.sym("out_value", rows)
        options: dict[str, Any] = {"enable_fd": True, "fd_method": "central", **NO_AD}  # for second derivatives
        custom = ca.Function(
            f"jac_{name}",
            [*symbols, result],
            derive.call([*symbols, result]),
            names,
            [f"jac_value_{key}" for key in ARGUMENTS],
            options,
        )
        return ca.Function(
            name,
            symbols,
            run.call(symbols),
            list(ARGUMENTS),
            ["value"],
            {"custom_jacobian": custom, "never_inline": True, **NO_AD},
        )


def _fill(result: Array | None, value: Array) -> None:
    if result is not None:
        result[:] = value.ravel(order="F")


class _Callback(ca.Callback):
    """Hands the memory of arguments and wanted results over as arrays; None for a result that is not wanted."""

    def __init__(
        self, name: str, sizes: Sequence[int], shapes: Sequence[tuple[int, int]], function: Callable[..., None]
    ):
        ca.Callback.__init__(self)
        self._sizes, self._shapes, self._function = sizes, shapes, function
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._sizes)

    def get_n_out(self) -> int:
        return len(self._shapes)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._shapes[i])

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arg: Sequence[Any], res: Sequence[Any]) -> int:
        pairs = zip(arg, self._sizes, strict=True)
        given = [np.zeros(size) if argument is None else np.frombuffer(argument) for argument, size in pairs]
        try:
            self._function([None if result is None else np.frombuffer(result) for result in res], *given)
        except FloatingPointError:
            return 1
        return 0
