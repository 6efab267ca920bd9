"""Designs: which values of the parameters a study tries."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ctmhe.errors import InputError

Label = str | float | int | bool
RESERVED = ("seed", "error", "seconds", "key")
"""Columns of a study's table that no parameter and no metric can be called."""


@dataclass(frozen=True, eq=False)
class Design:
    """Points of a study: for each the parameters' values, and the labels by which people know them.

    The labels of a parameter are all numbers or all text, so that they make a column. `a * b` combines every point of
    one design with every point of the other.

    Attributes
    ----------
    parameters : tuple of str
    labels : tuple of tuple
        One row a point, in the order of `parameters`.
    values : tuple of tuple
        What the case is called with, likewise.
    """

    parameters: tuple[str, ...]
    labels: tuple[tuple[Label, ...], ...]
    values: tuple[tuple[Any, ...], ...]

    def __post_init__(self) -> None:
        for name in self.parameters:
            if not isinstance(name, str) or not name.replace(".", "_").isidentifier():  # dots: keys of described cases
                raise InputError(f"design: a parameter is a keyword of the case, {name!r} cannot be one")
            if name in RESERVED:
                raise InputError(f"design: a parameter cannot be called {name!r}; choose another name")
        if len(set(self.parameters)) < len(self.parameters):
            raise InputError(f"design: a parameter is named twice in {', '.join(self.parameters)}")
        if not self.labels:
            raise InputError("design: there are no points; give every parameter at least one value")
        columns = [_column(column) for column in zip(*self.labels, strict=True)]
        labels = tuple(zip(*columns, strict=True)) if columns else self.labels
        object.__setattr__(self, "labels", labels)
        seen: set[tuple[Label, ...]] = set()
        for row in labels:
            if row in seen:
                raise InputError(
                    f"design: two points are called {named(self.parameters, row)}; leave one out, or tell values apart "
                    "by labels: {'policy': {'tight': ..., 'loose': ...}}"
                )
            seen.add(row)

    def __len__(self) -> int:
        return len(self.labels)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for row in self.values:
            yield dict(zip(self.parameters, row, strict=True))

    def __mul__(self, other: Design) -> Design:
        pairs = list(product(range(len(self)), range(len(other))))
        return Design(
            (*self.parameters, *other.parameters),
            tuple(self.labels[i] + other.labels[j] for i, j in pairs),
            tuple(self.values[i] + other.values[j] for i, j in pairs),
        )


def full_grid(grid: Mapping[str, Any]) -> Design:
    """Return every combination of the parameters' values; the last parameter varies first.

    Parameters
    ----------
    grid : mapping parameter -> sequence of values, or mapping label -> value
        Labels name what has no short name of its own, such as policies. Without them numbers, text and booleans are
        their own labels, anything else is called by its `repr`.

    Raises
    ------
    InputError
        For a parameter without values, and for two values with one label.
    """
    design = Design((), ((),), ((),))
    for name, values in grid.items():
        design = design * _axis(name, values)
    return design


def latin_hypercube(space: Mapping[str, Any], points: int, seed: int = 0, *, log: Sequence[str] = ()) -> Design:
    """Return a Latin hypercube: each of `points` equal slices of every parameter's range is met once.

    Parameters
    ----------
    space : mapping parameter -> (low, high)
    points : int
    seed : int
    log : sequence of str
        Parameters whose logarithm is spread evenly.
    """
    from scipy.stats import qmc

    unit = qmc.LatinHypercube(d=len(space), rng=np.random.default_rng(seed)).random(_count(points))
    return _spread(space, unit, log)


def sobol(space: Mapping[str, Any], points: int, seed: int = 0, *, log: Sequence[str] = ()) -> Design:
    """Return the first points of a scrambled Sobol sequence; powers of two are balanced best.

    The parameters are those of `latin_hypercube`. With the same seed, more points begin with the same points, so that a
    study can be extended.
    """
    from scipy.stats import qmc

    points = _count(points)
    sequence = qmc.Sobol(d=len(space), rng=np.random.default_rng(seed))
    unit = sequence.random_base2(int(np.ceil(np.log2(points))))[:points]
    return _spread(space, unit, log)


def from_table(rows: Any) -> Design:
    """Return the design of a user's table.

    Parameters
    ----------
    rows : sequence of mappings parameter -> value, or DataFrame
        Every row is a point and names the same parameters.
    """
    if hasattr(rows, "to_dict"):
        rows = rows.to_dict("records")
    rows = list(rows)
    if not rows or not all(isinstance(row, Mapping) for row in rows):
        raise InputError("design: a table is a sequence of mappings from parameter to value, one a point")
    parameters = tuple(rows[0])
    for row in rows:
        if set(row) != set(parameters):
            raise InputError(
                f"design: rows of a table name the same parameters; {set(row) ^ set(parameters)} is not in all"
            )
    values = tuple(tuple(row[name] for name in parameters) for row in rows)
    return Design(parameters, tuple(tuple(map(label_of, row)) for row in values), values)


def as_design(grid: Any) -> Design:
    """Return the design that a mapping (a full grid), a table or a design stands for."""
    if isinstance(grid, Design):
        return grid
    if isinstance(grid, Mapping):
        return full_grid(grid)
    if isinstance(grid, Iterable) and not isinstance(grid, str):
        return from_table(grid)
    raise InputError(f"design: expected a mapping parameter -> values, a Design or a table, got {grid!r}")


def label_of(value: Any) -> Label:
    """Return what people see in place of a value."""
    if isinstance(value, (np.bool_, np.integer, np.floating)):
        value = value.item()
    return value if isinstance(value, (bool, int, float, str)) else repr(value)


def named(parameters: Sequence[str], labels: Sequence[Label]) -> str:
    """Return `policy='even', delta=0.1` for messages."""
    return ", ".join(f"{name}={label!r}" for name, label in zip(parameters, labels, strict=True)) or "the only point"


def _axis(name: str, values: Any) -> Design:
    if isinstance(values, Mapping):
        for label in values:
            if not isinstance(label, (str, int, float)):
                raise InputError(f"design: {name}: labels are text or numbers, got {label!r}")
        pairs = list(values.items())
    elif isinstance(values, Iterable) and not isinstance(values, (str, bytes)):
        pairs = [(label_of(value), value.item() if isinstance(value, np.generic) else value) for value in values]
    else:
        raise InputError(f"design: {name}: expected a list of values or a mapping label -> value, got {values!r}")
    if not pairs:
        raise InputError(f"design: {name} has no values")
    return Design((name,), tuple((label,) for label, _ in pairs), tuple((value,) for _, value in pairs))


def _column(labels: tuple[Label, ...]) -> tuple[Label, ...]:
    """Return labels of one kind: booleans, whole numbers, numbers or text."""
    if all(isinstance(label, bool) for label in labels):
        return labels
    if any(isinstance(label, (bool, str)) for label in labels):
        return tuple(str(label) for label in labels)
    if any(np.isnan(label) for label in labels):
        raise InputError("design: NaN cannot be a value of a parameter")
    return labels if all(isinstance(label, int) for label in labels) else tuple(float(label) for label in labels)


def _count(points: int) -> int:
    if isinstance(points, bool) or not isinstance(points, (int, np.integer)) or points < 1:
        raise InputError(f"design: points must be a whole number of at least 1, got {points!r}")
    return int(points)


def _spread(space: Mapping[str, Any], unit: np.ndarray, log: Sequence[str]) -> Design:
    """Return the points of the unit cube (n, parameters) in the ranges of `space`."""
    for name in log:
        if name not in space:
            raise InputError(f"design: log names {name!r}, which is not in the space: {', '.join(space)}")
    columns = []
    for (name, pair), u in zip(space.items(), unit.T, strict=True):
        low, high = bounds_of(name, pair, name in log)
        columns.append(low * (high / low) ** u if name in log else low + (high - low) * u)
    rows = tuple(tuple(float(value) for value in row) for row in np.array(columns).T)
    return Design(tuple(space), rows, rows)


def bounds_of(name: str, pair: Any, log: bool) -> tuple[float, float]:
    """Return a checked range (low, high) of a parameter."""
    try:
        low, high = (float(value) for value in pair)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected a range (low, high), got {pair!r}") from None
    if not (np.isfinite([low, high]).all() and low < high and (low > 0 or not log)):
        rule = "0 < low < high" if log else "low < high"
        raise InputError(f"{name}: a range needs {rule}, both finite, got ({low:g}, {high:g})")
    return low, high
