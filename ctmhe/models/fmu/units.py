"""From one unit to another, by what an FMU says of its units and by what everybody knows."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class Unit(NamedTuple):
    """A unit in SI base units: value in base units = `factor` * value + `offset`.

    `exponents` belong to kg, m, s, A, K, mol, cd, rad.
    """

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0


def _unit(factor: float = 1.0, offset: float = 0.0, **exponents: int) -> Unit:
    return Unit(tuple(exponents.get(base, 0) for base in BASE), factor, offset)


# Spellings of logs that an FMU may not define; what it does define counts.
COMMON: dict[str, Unit] = {
    "1": _unit(),
    "%": _unit(0.01),
    "s": _unit(s=1),
    "min": _unit(60.0, s=1),
    "h": _unit(3600.0, s=1),
    "K": _unit(K=1),
    "degC": _unit(1.0, 273.15, K=1),
    "°C": _unit(1.0, 273.15, K=1),
    "Pa": _unit(kg=1, m=-1, s=-2),
    "kPa": _unit(1e3, kg=1, m=-1, s=-2),
    "mbar": _unit(1e2, kg=1, m=-1, s=-2),
    "bar": _unit(1e5, kg=1, m=-1, s=-2),
    "W": _unit(kg=1, m=2, s=-3),
    "kW": _unit(1e3, kg=1, m=2, s=-3),
}


def known_unit(units: Mapping[str, Unit], name: str) -> Unit | None:
    """Return a unit as the FMU defines it, else as it is commonly understood, else None."""
    return units.get(name) or COMMON.get(name)


def conversion(units: Mapping[str, Unit], from_unit: str, to_unit: str) -> tuple[float, float] | None:
    """Return (factor, offset) of value in `to_unit` = factor * value in `from_unit` + offset.

    Parameters
    ----------
    units : mapping name -> Unit
        `Description.units`.
    from_unit, to_unit : str

    Returns
    -------
    tuple of float, or None
        None when the two measure different things, or one of them is unknown.
    """
    if from_unit == to_unit:
        return 1.0, 0.0
    here, there = known_unit(units, from_unit), known_unit(units, to_unit)
    if here is None or there is None or here.exponents != there.exponents:
        return None
    return here.factor / there.factor, (here.offset - there.offset) / there.factor


def instruction(factor: float, offset: float) -> str:
    """Return a conversion in words: `multiply by 1e-5`, `add 273.15`, or both; empty when nothing changes."""
    steps = []
    if not math.isclose(factor, 1.0, rel_tol=1e-12):
        steps.append(f"multiply by {_plain(factor)}")
    if offset:
        steps.append(f"{'add' if offset > 0 else 'subtract'} {_plain(abs(offset))}")
    return ", then ".join(steps)


def _plain(number: float) -> str:
    return re.sub(r"e([+-])0*", r"e\1", f"{number:.12g}").replace("e+", "e")
