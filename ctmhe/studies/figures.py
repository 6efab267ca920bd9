"""Which figures fit a study, and the figures as SVG."""

from __future__ import annotations

import io
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.errors import InputError, MissingExtra
from ctmhe.plotting import (
    plot_error_against_samples,
    plot_gap_histogram,
    plot_heatmap,
    plot_paired_differences,
    plot_pareto,
    plot_run,
    plot_solve_times,
)
from ctmhe.plotting.style import WIDTH, title
from ctmhe.plotting.tables import groups
from ctmhe.studies.results import StudyResult

log = logging.getLogger(__name__)

ERRORS = ("online_rms", "retrospective_rms", "ise")
EFFORTS = ("samples", "solves", "messages", "bytes_sent")
FAMILIES = 9
"""So many lines can be told apart."""
PAIRS = 24
"""So many differences stand one under the other; the table has all of them."""
RUNS = 40
"""So many trajectories a family are read for distributions."""


@dataclass(frozen=True)
class Picture:
    """A figure as SVG, and what it shows."""

    svg: bytes
    caption: str


@dataclass(frozen=True, eq=False)
class Roles:
    """What the columns of a study's table are for.

    Attributes
    ----------
    texts, numbers : list of str
        Parameters with labels, and with numbers, that take more than one value.
    error, effort : str or None
        The metric that judges a point, and what it is paid with; None where the study has no such metric.
    """

    texts: list[str]
    numbers: list[str]
    error: str | None
    effort: str | None

    @classmethod
    def of(cls, result: StudyResult) -> Roles:
        """Return the roles in a result."""
        varied = varied_in(result)
        texts = [name for name in varied if any(isinstance(v, (str, bool)) for v in result.table[name].unique())]
        known = [name for name in numeric(result) if np.isfinite(result.table[name].to_numpy(dtype=float)).any()]
        error = next((name for name in (*ERRORS, *known) if name in known), None)
        effort = next((name for name in EFFORTS if name in known and name != error), None)
        return cls(texts, [name for name in varied if name not in texts], error, effort)


def varied_in(result: StudyResult) -> list[str]:
    """Return the parameters that take more than one value."""
    return [name for name in result.parameters if len(set(result.table[name].tolist())) > 1]


def numeric(result: StudyResult) -> list[str]:
    """Return the metrics that are numbers."""
    kinds = (bool, int, float, np.number, np.bool_)
    return [name for name in result.metrics if all(isinstance(v, kinds) for v in result.table[name].dropna())]


def pictures(result: StudyResult, roles: Roles, differences: Any = None) -> list[Picture]:
    """Return the figures that fit; one that cannot be drawn is left out, and logged.

    Parameters
    ----------
    result : StudyResult
    roles : Roles
    differences : DataFrame, optional
        Paired differences of `roles.error`, see `StudyResult.compare`.
    """
    table = plain(result.table, result.parameters)
    drawn: list[Picture | None] = []
    by, along = families(table, roles)
    error, effort = roles.error, roles.effort
    every = f"means over the seeds{over(roles, [*by, *along])} with 95 % intervals"
    if error and effort:
        count = table.groupby(by, dropna=False).ngroups if by else 1
        if count <= FAMILIES:
            drawn.append(
                draw(
                    lambda axes: plot_error_against_samples(
                        table, axes, error=error, samples=effort, by=by, parameter=along
                    ),
                    f"{_capital(title(error))} against {title(effort)}: {every}.",
                )
            )
        names = [*roles.texts, *roles.numbers]
        points = table.groupby(names, dropna=False).ngroups if names else 1
        if points > 2:
            shown = by if count <= FAMILIES else []
            rest = [name for name in names if name not in shown]
            drawn.append(
                draw(
                    lambda axes: plot_pareto(table, axes, x=effort, y=error, by=shown, parameter=rest or names),
                    f"Means of all {points} points; the staircase joins those that no other point beats in both.",
                )
            )
    if error and len(roles.numbers) >= 2:
        x, y = roles.numbers[:2]
        rows = table[y].nunique()
        if rows <= 40 and table[x].nunique() <= 60 and len(table[[x, y]].drop_duplicates()) > max(rows, 3):
            drawn.append(
                draw(
                    lambda axes: plot_heatmap(table, axes, x=x, y=y, value=error),
                    f"{_capital(title(error))} over {x} and {y}: mean over the seeds{over(roles, [x, y])}.",
                    height=min(9.0, max(2.4, 1.2 + 0.42 * rows)),
                )
            )
    if differences is not None and 0 < len(differences) <= PAIRS:
        compared = plain(differences, result.parameters)
        names = [name for name in result.parameters if compared[name].nunique() > 1] or list(result.parameters)
        drawn.append(
            draw(
                lambda axes: plot_paired_differences(
                    compared, axes, by=names, xlabel=f"{title(str(error))}: paired difference to the baseline"
                ),
                "Paired differences with 95 % intervals: left of zero is better, filled where zero is outside.",
                height=1.1 + 0.34 * len(compared),
            )
        )
    return [picture for picture in (*drawn, *_of_runs(result, table, by)) if picture is not None]


def families(table: Any, roles: Roles) -> tuple[list[str], list[str]]:
    """Return the columns that tell families apart, and the one that moves along a family's line.

    Labels tell apart, else the number with the fewest values where there are two; the line follows the number that
    changes the effort most.
    """
    by = roles.texts
    if not by and len(roles.numbers) > 1:
        by = [min(roles.numbers, key=lambda name: table[name].nunique())]
    rest = [name for name in roles.numbers if name not in by]
    if len(rest) < 2 or roles.effort is None:
        return by, rest
    return by, [max(rest, key=lambda name: np.ptp(table.groupby(name)[roles.effort].mean().to_numpy(dtype=float)))]


def draw(plot: Callable[[Any], Any], caption: str, height: float = 4.0) -> Picture | None:
    """Return a figure, None where there is nothing to draw."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("matplotlib", "plot", "Drawing") from error
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    try:
        plot(figure.add_subplot())
        return Picture(svg(figure), caption)
    except (InputError, ValueError) as error:
        log.warning("study: figure %r is left out: %s", caption, error)
        return None


def svg(figure: Any) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "ctmhe"}), io.BytesIO() as file:
        figure.savefig(file, format="svg", metadata={"Date": None})
        return file.getvalue()


def plain(table: Any, parameters: Any) -> Any:
    """Return the table with dollar signs in labels as they are: not as mathematics, which may not parse."""
    shown = table.copy()
    for name in parameters:
        shown[name] = [value.replace("$", r"\$") if isinstance(value, str) else value for value in shown[name]]
    return shown


def over(roles: Roles, shown: list[str]) -> str:
    """Return, in words, what else a mean is taken over."""
    return "".join(f" and {name}" for name in (*roles.texts, *roles.numbers) if name not in shown)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _of_runs(result: StudyResult, table: Any, by: list[str]) -> list[Picture | None]:
    """Return gaps, solve times and the timeline of the first run, where trajectories were kept."""
    kept = {}
    for name, rows in list(groups(table[table["error"] == ""], by))[:FAMILIES]:
        found = [run for run in (_kept(result, int(i)) for i in rows.index[:RUNS]) if run is not None]
        if found:
            kept[name] = found
    if not kept:
        return []
    shown = f"up to {RUNS} runs each"
    return [
        draw(lambda axes: plot_gap_histogram(kept, axes), f"Gaps between samples, {shown}."),
        draw(lambda axes: plot_solve_times(kept, axes), f"Share of solves that took no longer, {shown}."),
        _timeline(next(iter(kept.values()))[0], next(iter(kept))),
    ]


def _kept(result: StudyResult, row: int) -> Any:
    try:
        return result.run(row)
    except InputError:
        return None


def _timeline(run: Any, name: str) -> Picture:
    from matplotlib import pyplot

    axes = plot_run(run.dataset)
    try:
        return Picture(svg(axes[0].figure), f"The first run of {name.replace(chr(92) + '$', '$')}.")
    finally:
        pyplot.close(axes[0].figure)
