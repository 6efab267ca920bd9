"""CasADi functions of scalar expressions as tapes of instructions for the core, which runs several slots at once."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import casadi as ca
import numpy as np

logger = logging.getLogger(__name__)

BATCH = 8  # slots at once: CTMHE_BATCH of core.h
LARGE = 50_000  # instructions from which reading them one by one takes too long

# In the order of `enum operation` in core/tape.h. CasADi's numbers belong to its version, the names do not.
OPERATIONS = (
    "INPUT", "OUTPUT", "CONST", "ASSIGN", "ADD", "SUB", "MUL", "DIV", "NEG", "SQ", "TWICE", "INV", "SQRT", "EXP", "LOG",
    "POW", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH", "ATAN2",
    "FABS", "SIGN", "COPYSIGN", "FLOOR", "CEIL", "FMOD", "FMIN", "FMAX", "LT", "LE", "EQ", "NE", "NOT", "AND", "OR",
    "IF_ELSE_ZERO", "ERF", "LOG1P", "EXPM1", "HYPOT", "REMAINDER",
)  # fmt: skip
INPUT, OUTPUT, CONSTANT = range(3)
CODES = {getattr(ca, f"OP_{name}"): code for code, name in enumerate(OPERATIONS) if hasattr(ca, f"OP_{name}")}
CODES[ca.OP_CONSTPOW] = OPERATIONS.index("POW")
CODES[ca.OP_LIFT] = OPERATIONS.index("ASSIGN")


@dataclass(frozen=True, eq=False)
class Tape:
    """A function as data.

    Attributes
    ----------
    instructions : int32 array (m, 4)
        Operation, target, left, right: registers; for inputs and outputs the number of the argument or result and the
        element in it, for constants its number.
    constants : array
    registers : int
    """

    instructions: np.ndarray
    constants: np.ndarray
    registers: int


def tape_of(function: ca.Function) -> Tape | None:
    """Return the tape of a function with dense arguments, None where it is more than known scalar instructions."""
    if not function.is_a("SXFunction") or function.n_instructions() > LARGE:
        return None
    rows, constants = [], []
    for k in range(function.n_instructions()):
        code = CODES.get(function.instruction_id(k))
        if code is None:
            logger.info("operation %d of %s is left to CasADi", function.instruction_id(k), function.name())
            return None
        if code == CONSTANT:
            rows.append((code, function.instruction_output(k)[0], len(constants), 0))
            constants.append(function.instruction_constant(k))
            continue
        left, *right = function.instruction_input(k)
        target, *element = function.instruction_output(k)
        if code == OUTPUT:
            rows.append((code, target, left, element[0]))
        else:
            rows.append((code, target, left, right[0] if right else left))
    return Tape(np.array(rows, np.int32).reshape(-1, 4), np.array(constants or [0.0]), max(function.sz_w(), 1))
