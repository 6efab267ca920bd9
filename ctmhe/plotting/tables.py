"""What figures need of a study's table: families, means over seeds with their intervals, the front."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.statistics import interval
from ctmhe.types import Array

Columns = str | Sequence[str] | None


def columns_of(columns: Columns) -> list[str]:
    """Return names of columns as a list."""
    return [] if columns is None else [columns] if isinstance(columns, str) else list(columns)


def require(table: Any, names: Sequence[str], what: str) -> None:
    """Raise `InputError` for a column that the table does not have."""
    for name in names:
        if name not in table.columns:
            near = get_close_matches(name, map(str, table.columns), n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise InputError(f"{what}: no column {name!r}{hint} Columns: {', '.join(map(str, table.columns))}")


def groups(table: Any, by: Columns) -> Iterator[tuple[str, Any]]:
    """Yield (label, rows) for every combination of values in the columns `by`, in the order of first appearance."""
    names = columns_of(by)
    if not names:
        yield "all", table
        return
    for key, rows in table.groupby(names, sort=False, dropna=False):
        yield label(key if isinstance(key, tuple) else (key,), names), rows


def label(values: Sequence[Any], names: Sequence[str]) -> str:
    """Return a family's label: texts as they are, numbers with the name of their column."""
    return ", ".join(
        value if isinstance(value, str) else f"{name} = {number(value)}"
        for name, value in zip(names, values, strict=True)
    )


def number(value: Any) -> str:
    """Return a value of a table as short text."""
    return f"{value:.3g}" if isinstance(value, (float, np.floating)) else str(value)


def means(table: Any, by: Columns, metrics: Sequence[str], confidence: float = 0.95) -> Array:
    """Return mean, lower, upper limit and number of runs for each group and metric, (groups, metrics, 4).

    Student's interval of the mean over the runs whose metrics are all finite; NaN limits for a single run.
    """
    rows = []
    for _, group in groups(table, by):
        values = group[list(metrics)].to_numpy(dtype=float)
        values = values[np.isfinite(values).all(axis=1)]
        if len(values):
            found = [interval(column, confidence) for column in values.T]
            rows.append([(mean, low, high, len(values)) for mean, _, low, high in found])
    return np.array(rows, dtype=float).reshape(len(rows), len(metrics), 4)


def count(numbers: Any) -> str:
    """Return how many runs stand behind points: `n = 20` or `n = 18 to 20`."""
    low, high = int(min(numbers)), int(max(numbers))
    return f"n = {low}" if low == high else f"n = {low} to {high}"
