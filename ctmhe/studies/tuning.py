"""Choosing a policy's parameters: a threshold for a wanted result, and what no other choice beats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.statistics import non_dominated
from ctmhe.studies.design import bounds_of
from ctmhe.studies.study import Study
from ctmhe.types import names_of

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Threshold:
    """A value of a parameter at which the mean of a metric is what was wanted.

    Attributes
    ----------
    value : float
        The best value tried.
    mean, low, high : float
        Mean of the metric there over the seeds, and its 95 % confidence interval.
    reached : bool
        The mean is within the tolerance.
    history : DataFrame
        All values tried, in this order: the parameter, `n`, `failed`, `mean`, `sd`, `low`, `high`.
    message : str
        Why the search ended.
    """

    value: float
    mean: float
    low: float
    high: float
    reached: bool
    history: pd.DataFrame
    message: str


def find_threshold(
    case: Callable[..., Any],
    parameter: str,
    bracket: tuple[float, float],
    *,
    target: Mapping[str, float],
    seeds: int | Iterable[int] = range(20),
    tolerance: float = 0.01,
    resolution: float = 1e-3,
    log: bool = True,
    workers: int = 1,
    executor: Any = None,
    folder: str | Path | None = None,
    progress: bool = False,
) -> Threshold:
    """Find the value of a parameter at which the mean of a metric over seeds is what is wanted.

    The mean has to be on different sides of the target at the ends of the bracket; in between it may rise or fall, with
    noise and steps. The bracket is divided by its secant and its middle in turn, so that two steps halve it at least.

    Parameters
    ----------
    case : callable (*, seed, <parameter>)
        As for `Study`; fix other parameters by `functools.partial`.
    parameter : str
    bracket : (low, high)
    target : mapping
        One metric and its wanted mean, such as `{"samples": 50}`.
    seeds : int or sequence of int
        The same for all values.
    tolerance : float
        Relative to the target: the search ends when the mean is that near.
    resolution : float
        The search ends too when the bracket is narrower than this, relative to its upper end (to its width at the start
        with log=False).
    log : bool
        Divide the bracket on a logarithmic scale; needs 0 < low.
    workers, executor, folder, progress
        As for `Study` and `Study.run`.

    Returns
    -------
    Threshold

    Raises
    ------
    InputError
        When the bracket does not enclose the target, or no run has a value.
    """
    low, high = bounds_of(parameter, bracket, log)
    if not isinstance(target, Mapping) or len(target) != 1:
        raise InputError(
            f"find_threshold: target is one metric and its value, such as {{'samples': 50}}, got {target!r}"
        )
    ((metric, wanted),) = target.items()
    rows: list[dict[str, Any]] = []
    run = {"workers": workers, "executor": executor, "progress": progress}

    def gap(value: float) -> float:
        """Return the mean at a value minus the target."""
        rows.append(_tried(case, parameter, value, metric, seeds, folder, run))
        return rows[-1]["mean"] - wanted

    def scale(value: float) -> float:
        return float(np.log(value)) if log else value

    slack = tolerance * abs(wanted) if wanted else tolerance
    gap_low, gap_high = gap(low), gap(high)
    if min(abs(gap_low), abs(gap_high)) > slack and gap_low * gap_high > 0:
        raise InputError(
            f"find_threshold: the bracket does not enclose {metric} = {wanted:g}: it is {gap_low + wanted:.4g} at "
            f"{parameter} = {low:g} and {gap_high + wanted:.4g} at {parameter} = {high:g}; widen the bracket"
        )
    width, smooth, message = high - low, True, ""
    while not message:
        if min(abs(row["mean"] - wanted) for row in rows) <= slack:
            message = f"{metric} is within {tolerance:g} of the target"
        elif high - low <= resolution * (high if log else width):
            message = f"the bracket is down to ({low:.6g}, {high:.6g}): {metric} jumps across the target there"
        else:
            share = gap_low / (gap_low - gap_high) if smooth else 0.5
            share, smooth = min(max(share, 0.1), 0.9), not smooth
            between = scale(low) + share * (scale(high) - scale(low))
            middle = float(np.exp(between)) if log else between
            here = gap(middle)
            if here * gap_low > 0:
                low, gap_low = middle, here
            else:
                high, gap_high = middle, here
    import pandas as pd

    best = min(reversed(rows), key=lambda row: abs(row["mean"] - wanted))
    reached = abs(best["mean"] - wanted) <= slack
    if not _monotone(rows, parameter):
        message += f"; {metric} is not monotone in {parameter}: there may be other solutions"
    ends = (best["mean"], best["low"], best["high"])
    return Threshold(best[parameter], *ends, bool(reached), pd.DataFrame(rows), message)


def pareto_front(table: pd.DataFrame, minimise: Sequence[str], maximise: Sequence[str] = ()) -> pd.DataFrame:
    """Return the rows that no other row beats: as good in all of these columns, and better in one.

    Parameters
    ----------
    table : DataFrame
        Such as `StudyResult.means("samples", "online_rms")`. Rows with NaN in one of these columns are left out.
    minimise, maximise : sequence of str

    Returns
    -------
    DataFrame
        Sorted by the first column named.
    """
    wanted = [(name, 1.0) for name in names_of(minimise)] + [(name, -1.0) for name in names_of(maximise)]
    for name, _ in wanted:
        if name not in table.columns:
            raise InputError(f"pareto_front: no column {name!r}. Columns: {', '.join(map(str, table.columns))}")
    if not wanted:
        raise InputError("pareto_front: name a column to minimise or maximise")
    costs = np.column_stack([sign * table[name].to_numpy(dtype=float) for name, sign in wanted])
    front = np.flatnonzero(non_dominated(costs))
    return table.iloc[sorted(front, key=lambda i: tuple(costs[i]))]


def _tried(
    case: Callable[..., Any], parameter: str, value: float, metric: str, seeds: Any, folder: Any, run: dict[str, Any]
) -> dict[str, Any]:
    """Return the row of the history that belongs to a value."""
    here = None if folder is None else Path(folder) / f"{parameter}={value:.17g}"
    result = Study(case, {parameter: [value]}, seeds, folder=here, name=f"{parameter}={value:.4g}").run(**run)
    if len(result.failed) == len(result.table):
        raise InputError(
            f"find_threshold: every run at {parameter} = {value:g} failed, the first with {result.table['error'][0]}"
        )
    (row,) = result.summary(metric).to_dict("records")
    if np.isnan(row["mean"]):
        raise InputError(f"find_threshold: {metric} is NaN at {parameter} = {value:g}")
    return row


def _monotone(rows: Sequence[Mapping[str, Any]], parameter: str) -> bool:
    """Return whether the means rise, or fall, along the parameter: as far as their confidence intervals tell."""
    ordered = sorted(rows, key=lambda row: row[parameter])
    ends = [np.nan_to_num([row["low"], row["high"]], nan=row["mean"]) for row in ordered]
    rises = any(b[0] > a[1] for a, b in pairwise(ends))
    falls = any(b[1] < a[0] for a, b in pairwise(ends))
    return not (rises and falls)
