"""An unpacked FMU as CasADi functions of (t, x, u, w, p) whose derivatives can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import FmuError
from ctmhe.models.continuous import ARGUMENTS
from ctmhe.models.fmu.description import MODEL_EXCHANGE, Description, Variable
from ctmhe.types import Array

# CasADi's own directional derivatives of FMUs are silently wrong inside mapped functions (a zero seed returns
# the previous result). Both modes are off, and every derivative is taken from one Jacobian.
NO_AD = {"enable_forward": False, "enable_reverse": False}
# An FMU that CasADi exported may carry a symbolic copy of the model: evaluate the binary, not the copy.
BINARY_ONLY = {"enable_ls_serialization": False}


class FmuFunctions:
    """Makes the two functions of a model; each call instantiates the FMU anew.

    Parameters
    ----------
    folder : Path
        Where the FMU is unpacked.
    description : Description
    inputs, outputs, parameters : sequence of Variable
        What becomes u, y and p; an output may be a state.
    values : mapping name -> value
        Start values other than the FMU's own.
    entry, exit : array (nx, nw), (ny, nw)
        How w adds to the derivatives and to the outputs.
    """

    def __init__(
        self,
        folder: Path,
        description: Description,
        *,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        parameters: Sequence[Variable],
        values: Mapping[str, float],
        entry: Array,
        exit: Array,
    ):
        self._about, self._entry, self._exit = description, entry, exit
        try:
            builder = ca.DaeBuilder(identifier(description.name), str(folder), BINARY_ONLY)
            for category, chosen in (("u", inputs), ("p", parameters)):
                names = [variable.name for variable in chosen]
                for name in getattr(builder, category)():
                    if name not in names:
                        builder.set_category(name, "c")
                builder.reorder(category, names)
            builder.reorder("x", [state.name for state in description.states])
            for name, value in values.items():
                builder.set(name, float(value))
            self._declared = list(builder.y())
        except Exception as error:
            raise _explained(description, error) from error
        self._builder = builder
        states = [state.name for state in description.states]
        self._rows = [
            self._declared.index(v.name) if v.name in self._declared else len(self._declared) + states.index(v.name)
            for v in outputs
        ]

    def create(self) -> tuple[ca.Function, ca.Function]:
        """Return (dynamics, output), each of (t, x, u, w, p) with one dense output `value`."""
        try:
            return self._function("f", "ode", self._entry), self._function("h", "y", self._exit)
        except Exception as error:
            raise _explained(self._about, error) from error

    def _function(self, name: str, what: str, spread: Array) -> ca.Function:
        inner = ["t", "x", "u", "p"]
        value = self._builder.create(f"{name}_fmu", inner, [what], NO_AD)
        columns = [f"jac_{what}_{key}" for key in "xup"]
        options: dict[str, Any] = dict(NO_AD)
        if not self._about.kinds[MODEL_EXCHANGE].directional_derivatives:
            options["fd_method"] = "central"
        jacobian = self._builder.create(f"jac_{name}_fmu", inner, columns, options)
        timed = self._builder.create("timed", inner, [f"jac_{what}_t"], NO_AD).nnz_out(0) > 0

        nx = len(self._about.states)
        sizes = {"t": 1, "x": nx, "u": value.size1_in(2), "w": spread.shape[1], "p": value.size1_in(3)}
        symbols = {key: ca.MX.sym(key, sizes[key]) for key in ARGUMENTS}
        t, x, u, w, p = symbols.values()

        def evaluate(time: ca.MX) -> ca.MX:
            return self._pick(value(time, x, u, p), x, what) + ca.DM(spread) @ w

        by = dict(zip("xup", jacobian(t, x, u, p), strict=True))
        rows = spread.shape[0]
        zero = {key: ca.MX(ca.DM(nx, sizes[key])) for key in "xup"} | {"x": ca.MX(ca.DM.eye(nx))}
        blocks = {key: self._pick(by[key], zero[key], what) for key in "xup"}
        blocks["w"] = ca.MX(ca.sparsify(ca.DM(spread)))
        # The derivative in time is never asked of the FMU (generated code has been seen to crash on it); where
        # the FMU says that time matters, it is a central difference.
        reach = np.cbrt(np.finfo(float).eps) * ca.fmax(1, ca.fabs(t))
        slope = (evaluate(t + reach) - evaluate(t - reach)) / (2 * reach) if timed else ca.MX(rows, 1)
        blocks["t"] = slope

        names = list(ARGUMENTS)
        derivative = ca.Function(
            f"jac_{name}",
            [*symbols.values(), ca.MX.sym("out_value", ca.Sparsity(rows, 1))],
            [blocks[key] for key in ARGUMENTS],
            [*names, "out_value"],
            [f"jac_value_{key}" for key in ARGUMENTS],
            {
                "enable_fd": True,
                "fd_method": "central",
                **NO_AD,
            },  # second derivatives, for a solver that wants them
        )
        return ca.Function(
            name,
            list(symbols.values()),
            [ca.densify(evaluate(t))],
            names,
            ["value"],
            {"custom_jacobian": derivative, "never_inline": True, **NO_AD},
        )

    def _pick(self, declared: ca.MX, states: ca.MX, what: str) -> ca.MX:
        return ca.vertcat(declared, states)[self._rows, :] if what == "y" else declared


def identifier(name: str) -> str:
    """Return `name` as a CasADi name: letters, digits and single underscores."""
    words = "".join(c if c.isascii() and c.isalnum() else " " for c in name).split()
    return "_".join(["fmu", *words])


def _explained(description: Description, error: Exception) -> FmuError:
    text = " ".join(str(error).split())
    hint = ""
    if "dependencies" in text and "not implemented" in text:
        hint = ": its modelDescription.xml lists no `dependencies` of outputs and derivatives; export it with them"
    return FmuError(f"{description.name} cannot be evaluated by CasADi{hint} ({text[-400:]})")
