"""What the plants share: the choice of estimated parameters and the naming of additive disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array, frozen, names_of


class Parameters:
    """Constants of a plant, some of which the user chose to be the model's parameters `p`.

    Parameters
    ----------
    plant : str
        Name of the plant, for messages.
    values : mapping name -> value
        Nominal value of every constant that may be chosen.
    chosen : str or sequence of str
        Names of those that become `p`, in the order of `p`.

    Attributes
    ----------
    names : tuple of str
    start : array (np,)
        Nominal values of the chosen ones.

    Raises
    ------
    InputError
        For a name that the plant does not have, or one given twice.
    """

    def __init__(self, plant: str, values: Mapping[str, float], chosen: str | Sequence[str]):
        self.names = names_of(chosen)
        for name in self.names:
            if name not in values:
                near = get_close_matches(name, values, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else "."
                raise InputError(f"{plant}: unknown parameter {name!r}{hint} Known: {', '.join(values)}")
        if len(set(self.names)) != len(self.names):
            raise InputError(f"{plant}: parameters must differ, got {', '.join(self.names)}")
        self._values = dict(values)
        self.start: Array = frozen([values[name] for name in self.names])

    def __call__(self, p: Any) -> dict[str, Any]:
        """Return every constant by name: the symbol p[i] where it was chosen, its nominal value elsewhere."""
        return {**self._values, **{name: p[i] for i, name in enumerate(self.names)}}

    @property
    def nominal(self) -> dict[str, float]:
        """Magnitudes of the chosen parameters, for scaling."""
        return {name: abs(self._values[name]) or 1.0 for name in self.names}

    def box(self, bounds: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]] | None:
        """Return the part of `bounds` that concerns the chosen parameters; None where there is none."""
        return {name: bounds[name] for name in self.names if name in bounds} or None


def disturbances(states: Sequence[str], outputs: Sequence[str], noise: bool) -> tuple[str, ...]:
    """Return `w_<state>` for every state, followed by `v_<output>` for every output when there is noise."""
    return (*(f"w_{name}" for name in states), *(f"v_{name}" for name in outputs if noise))


POSITIVE = (0.0, float(np.inf))
