"""Figures of a study's table: error against samples, fronts, heat maps, paired differences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.plotting.style import SMALL, WIDTH, above_legend, ready, scale, style, title
from ctmhe.plotting.tables import Columns, columns_of, count, groups, means, number, require
from ctmhe.statistics import non_dominated


def plot_error_against_samples(
    table: Any,
    axes: Any = None,
    *,
    error: str = "online_rms",
    samples: str = "samples",
    by: Columns = "policy",
    parameter: Columns = None,
    confidence: float = 0.95,
) -> Any:
    """Draw mean error over mean number of samples, a line for each family, with Student's intervals over the runs.

    Parameters
    ----------
    table : pandas.DataFrame
        One row a run, as `StudyResult.table`. Runs without a finite value are left out and not counted in n.
    axes : Axes, optional
    error, samples : str
        Columns.
    by : str or sequence of str
        Columns that tell the families apart.
    parameter : str or sequence of str, optional
        Columns that move a family along its line, such as the threshold; without any a family is one point.
    confidence : float
        Of the intervals of both means; single runs have none.

    Returns
    -------
    Axes

    Raises
    ------
    InputError
        For a column that is not there, or a table without a finite row.
    """
    names, along = columns_of(by), columns_of(parameter)
    require(table, [error, samples, *names, *along], "plot_error_against_samples")
    axes = ready(axes)
    drawn = []
    for k, (name, rows) in enumerate(groups(table, names)):
        found = means(rows, along, (samples, error), confidence)
        if not len(found):
            continue
        found = found[np.argsort(found[:, 0, 0], kind="stable")]
        drawn.append(found)
        look = style(k)
        (x, left, right, n), (y, low, high, _) = found[:, 0].T, found[:, 1].T
        text = f"{name} ({count(n)})"
        if len(found) > 1:
            axes.fill_between(x, low, high, color=look["color"], alpha=0.15, linewidth=0)
        sides = [np.nan_to_num([a, b]) for a, b in ((x - left, right - x), (y - low, high - y))]
        axes.errorbar(
            x, y, xerr=sides[0], yerr=sides[1], **look, markersize=5.5, linewidth=1.5, elinewidth=0.9, label=text
        )
    if not drawn:
        raise InputError(f"plot_error_against_samples: no run has a finite {samples} and {error}")
    every = np.concatenate(drawn)
    scale(axes, every[:, 0, 0], "x")
    scale(axes, every[:, 1, 0], "y")
    axes.set_xlabel(f"{title(samples)}, mean of n runs")
    single = bool((every[:, 0, 3] < 2).all())
    axes.set_ylabel(title(error) + ("" if single else f"\nmean and {100 * confidence:g} % interval"))
    above_legend(axes)
    return axes


def plot_pareto(
    table: Any,
    axes: Any = None,
    *,
    x: str,
    y: str,
    by: Columns = None,
    parameter: Columns = None,
    front: bool = True,
) -> Any:
    """Draw points of two metrics, both better when smaller, and the staircase of those that no other point beats.

    Parameters
    ----------
    table : pandas.DataFrame
        One row a point; one row a run where `parameter` is given.
    axes : Axes, optional
    x, y : str
        Columns.
    by : str or sequence of str, optional
        Columns that tell families apart; the front is that of all of them together.
    parameter : str or sequence of str, optional
        Points are means over the rows that agree in these columns (and in `by`).
    front : bool
        Whether to draw the staircase; points off it are pale.

    Returns
    -------
    Axes

    Raises
    ------
    InputError
        For a column that is not there, or a table without a finite row.
    """
    names, along = columns_of(by), columns_of(parameter)
    require(table, [x, y, *names, *along], "plot_pareto")
    axes = ready(axes)
    families = []
    for name, rows in groups(table, names):
        points = means(rows, along, (x, y))[:, :, 0] if along else rows[[x, y]].to_numpy(dtype=float)
        families.append((name, points[np.isfinite(points).all(axis=1)]))
    every = np.concatenate([points for _, points in families])
    if not len(every):
        raise InputError(f"plot_pareto: no row has a finite {x} and {y}")
    on_front = non_dominated(every)
    start = 0
    for k, (name, points) in enumerate(families):
        best = on_front[start : start + len(points)]
        start += len(points)
        look = {**style(k), "linestyle": "none", "markersize": 6.5}
        if front:
            axes.plot(*points[~best].T, **look, fillstyle="none", alpha=0.6)
            axes.plot(*points[best].T, **look)
            axes.plot([], [], **look, label=f"{name} ({count_on(best)})" if names else count_on(best))
        else:
            axes.plot(*points.T, **look, label=name if names else f"{len(points)} points")
    scale(axes, every[:, 0], "x")
    scale(axes, every[:, 1], "y")
    if front:
        corners = np.unique(every[on_front], axis=0)
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        edge_x = np.concatenate([corners[:1, 0], corners[:, 0], [right]])
        edge_y = np.concatenate([[top], corners[:, 1], corners[-1:, 1]])
        axes.plot(edge_x, edge_y, color="#444444", linewidth=1.1, drawstyle="steps-post", zorder=1, label="front")
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)
    axes.set_xlabel(title(x))
    axes.set_ylabel(title(y))
    above_legend(axes)
    return axes


def count_on(best: Any) -> str:
    """Return how many points lie on the front."""
    return f"{int(np.sum(best))} of {len(best)} on the front"


def plot_heatmap(table: Any, axes: Any = None, *, x: str, y: str, value: str) -> Any:
    """Draw a metric's mean over the runs for every pair of two parameters; numbers in the cells while these are few.

    Cells without a finite run are crossed out. The map (cividis) is even in lightness, so that it prints in grey.

    Parameters
    ----------
    table : pandas.DataFrame
        One row a run.
    axes : Axes, optional
    x, y, value : str
        Columns: two parameters and a metric.

    Returns
    -------
    Axes

    Raises
    ------
    InputError
        For a column that is not there, or a table without a finite row.
    """
    require(table, [x, y, value], "plot_heatmap")
    across, up = _levels(table[x]), _levels(table[y])
    axes = ready(axes, size=(WIDTH, min(9.0, max(2.4, 1.2 + 0.42 * len(up)))))
    cells = np.full((len(up), len(across)), np.nan)
    for i, level in enumerate(up):
        for j, other in enumerate(across):
            chosen = table.loc[(table[y] == level) & (table[x] == other), value].to_numpy(dtype=float)
            chosen = chosen[np.isfinite(chosen)]
            cells[i, j] = chosen.mean() if len(chosen) else np.nan
    if not np.isfinite(cells).any():
        raise InputError(f"plot_heatmap: no run has a finite {value}")
    axes.grid(visible=False)
    image = axes.pcolormesh(
        np.arange(len(across) + 1), np.arange(len(up) + 1), np.ma.masked_invalid(cells), cmap="cividis"
    )
    few = cells.size <= 120 and len(across) <= 12
    for i, j in np.ndindex(*cells.shape):
        if np.isnan(cells[i, j]):
            axes.plot([j, j + 1, np.nan, j, j + 1], [i, i + 1, np.nan, i + 1, i], color="#888888", linewidth=0.8)
        elif few:
            dark = image.norm(cells[i, j]) < 0.55
            colour = "white" if dark else "black"
            axes.annotate(
                f"{cells[i, j]:.3g}", (j + 0.5, i + 0.5), ha="center", va="center", fontsize=SMALL, color=colour
            )
    if any(isinstance(level, str) for level in up):
        axes.invert_yaxis()  # texts are read from the top
    for which, levels, name, most in (("x", across, x, 10), ("y", up, y, 16)):
        step = -(-len(levels) // most)  # no more labels than can be read
        ticks = range(0, len(levels), step)
        axis = getattr(axes, f"{which}axis")
        axis.set_ticks([k + 0.5 for k in ticks], [number(levels[k]) for k in ticks])
        axis.set_tick_params(length=0)
        getattr(axes, f"set_{which}label")(title(name))
    axes.spines[:].set_visible(False)
    axes.figure.colorbar(image, ax=axes, label=f"{title(value)}, mean", pad=0.02)
    return axes


def plot_paired_differences(
    comparison: Any,
    axes: Any = None,
    *,
    by: Columns = None,
    difference: str = "difference",
    low: str = "low",
    high: str = "high",
    xlabel: str = "paired difference to the baseline",
) -> Any:
    """Draw paired differences with their intervals, one under the other: left of zero is better than the baseline.

    A filled marker stands where the interval excludes zero, an open one where it does not.

    Parameters
    ----------
    comparison : pandas.DataFrame
        One row a comparison, as `StudyResult.compare` returns; rows are named by the columns `by`.
    axes : Axes, optional
    by : str or sequence of str, optional
        All columns in front of `difference` but the numbers of pairs when left out.
    difference, low, high : str
        Columns: mean difference and its interval.
    xlabel : str

    Returns
    -------
    Axes

    Raises
    ------
    InputError
        For a column that is not there, or an empty table.
    """
    require(comparison, [difference, low, high, *columns_of(by)], "plot_paired_differences")
    if not len(comparison):
        raise InputError("plot_paired_differences: there is nothing to compare")
    before = [str(column) for column in comparison.columns[: list(comparison.columns).index(difference)]]
    names = columns_of(by) or [name for name in before if name not in ("n", "dropped")]
    axes = ready(axes, size=(WIDTH, 1.1 + 0.34 * len(comparison)))
    ticks = _row_names(comparison, names)
    for row, (middle, left, right) in enumerate(comparison[[difference, low, high]].to_numpy(dtype=float)):
        look = {**style(0 if middle < 0 else 1), "linestyle": "-", "linewidth": 1.6, "markersize": 7}
        fill = look["color"] if left > 0 or right < 0 else "white"
        axes.plot([left, middle, right], [row] * 3, **look, markevery=[1], markerfacecolor=fill)
    axes.axvline(0.0, color="#444444", linewidth=0.9)
    axes.set_yticks(range(len(ticks)), ticks)
    axes.set_ylim(len(ticks) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    axes.locator_params(axis="x", nbins=6)
    axes.set_xlabel(xlabel)
    return axes


def _row_names(table: Any, names: Sequence[str]) -> list[str]:
    """Return a name for each row, with its number of pairs where the table has one."""
    pairs = table["n"] if "n" in table.columns else [None] * len(table)
    titles = [name for name, _ in groups(table.assign(_row=range(len(table))), [*names, "_row"])]
    titles = [name.rpartition(", _row = ")[0] if names else f"row {k}" for k, name in enumerate(titles)]
    return [f"{name} (n = {n})" if n is not None else name for name, n in zip(titles, pairs, strict=True)]


def _levels(column: Any) -> list[Any]:
    """Return the values of a parameter: numbers ascending, others in the order of first appearance."""
    values = list(dict.fromkeys(column.tolist()))
    return sorted(values) if all(isinstance(v, (int, float)) for v in values) else values
