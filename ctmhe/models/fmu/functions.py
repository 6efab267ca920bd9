"""An FMU as CasADi functions of (t, x, u, w, p), for what does not call its evaluator directly: CVODES, IPOPT."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import addressof, c_char
from threading import local
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
        self._ny = ny
        self.dynamics = self._function("f", nx, rates=True)
        self.output = self._function("h", ny, rates=False)

    def _function(self, name: str, rows: int, *, rates: bool) -> ca.Function:
        nx, nu, nw, n_p = (self._sizes[key] for key in "xuwp")
        first, ny = (0 if rates else nx), self._ny
        J = local()  # of this thread, (columns, nx + ny)

        def run(point: Sequence[Array | None], into: int, jacobian: int | None = None) -> None:
            evaluator = self._evaluators.mine()
            for own, given in zip(evaluator.point, point[1:], strict=True):
                if len(own):
                    own[:] = 0.0 if given is None else given
            t = 0.0 if point[0] is None else float(point[0][0])
            evaluator.run(t, into if rates else None, None if rates else into, jacobian)

        def moved(point: Sequence[Array | None], part: int, size: int, nominal: Array) -> Array:
            """Return the central differences (rows, size) with respect to one argument."""
            columns, values = np.zeros((rows, size)), np.zeros((2, rows))
            base = np.zeros(size) if point[part] is None else np.array(point[part])
            for j in range(size):
                step = REACH * max(nominal[j], abs(base[j]))
                for sign, value in zip((-1.0, 1.0), values, strict=True):
                    shifted = base.copy()
                    shifted[j] += sign * step
                    run([*point[:part], shifted, *point[part + 1 :]], value.ctypes.data)
                columns[:, j] = (values[1] - values[0]) / (2 * step)
            return columns

        def value(point: Sequence[Array | None], results: Sequence[Any]) -> None:
            if results[0] is not None:
                run(point, addressof(c_char.from_buffer(results[0])))

        def jacobian(point: Sequence[Array | None], results: Sequence[Any]) -> None:
            arrays = [None if result is None else np.frombuffer(result) for result in results]
            if any(arrays[i] is not None for i in (1, 3, 4)):
                if not hasattr(J, "all"):
                    J.all, J.value = np.zeros((nx + nw + n_p, nx + ny)), np.zeros(rows)
                    J.addresses = J.value.ctypes.data, J.all.ctypes.data
                run(point[:5], *J.addresses)
                block = J.all[:, first : first + rows]
                for i, columns in ((1, slice(0, nx)), (3, slice(nx, nx + nw)), (4, slice(nx + nw, None))):
                    _fill(arrays[i], block[columns])
            if arrays[0] is not None:
                _fill(arrays[0], moved(point[:5], 0, 1, np.ones(1)).T)
            if arrays[2] is not None:
                _fill(arrays[2], moved(point[:5], 2, nu, self._u_nominal).T)

        sizes = list(self._sizes.values())
        shapes = [(rows, size) for size in sizes]
        names = [*ARGUMENTS, "out_value"]
        labels = [f"jac_value_{key}" for key in ARGUMENTS]
        calculate = _Callback(f"{name}_fmu", ARGUMENTS, sizes, ["value"], [(rows, 1)], value, {})
        second: dict[str, Any] = {"enable_fd": True, "fd_method": "central", **NO_AD}  # for second derivatives
        derive = _Callback(f"jac_{name}", names, [*sizes, rows], labels, shapes, jacobian, second)
        self._kept += [calculate, derive]
        symbols = [ca.MX.sym(key, size) for key, size in self._sizes.items()]
        options: dict[str, Any] = {"custom_jacobian": derive, "never_inline": True, **NO_AD}
        return ca.Function(name, symbols, calculate.call(symbols), list(ARGUMENTS), ["value"], options)


def _fill(result: Array | None, value: Array) -> None:
    """Copy a matrix, given by its columns."""
    if result is not None:
        result[:] = value.ravel()


class _Callback(ca.Callback):
    """Hands on arguments as arrays and results as memory; None for what is zero, or is not wanted."""

    def __init__(
        self,
        name: str,
        names: Sequence[str],
        sizes: Sequence[int],
        labels: Sequence[str],
        shapes: Sequence[tuple[int, int]],
        function: Callable[[Sequence[Array | None], Sequence[Any]], None],
        options: dict[str, Any],
    ):
        ca.Callback.__init__(self)
        self._names, self._sizes, self._labels, self._shapes = names, sizes, labels, shapes
        self._function = function
        self.construct(name, options)

    def get_n_in(self) -> int:
        return len(self._sizes)

    def get_n_out(self) -> int:
        return len(self._shapes)

    def get_name_in(self, i: int) -> str:
        return self._names[i]

    def get_name_out(self, i: int) -> str:
        return self._labels[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(*self._shapes[i])

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arg: Sequence[Any], res: Sequence[Any]) -> int:
        try:
            self._function([None if argument is None else np.frombuffer(argument) for argument in arg], res)
        except FloatingPointError:
            return 1
        return 0
