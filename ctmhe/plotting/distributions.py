"""Distributions over the events of runs: gaps between samples, solve times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.plotting.style import SMALL, above_legend, ready, style
from ctmhe.types import Array


def plot_gap_histogram(gaps: Any, axes: Any = None, *, bins: int = 40) -> Any:
    """Draw how the gaps between samples are distributed, every family as the share of its gaps in common bins.

    Parameters
    ----------
    gaps : runs or seconds, or mapping label -> runs or seconds
        A `Run`, several, or an array of gaps. Of a run, the wait before the first sample is left out.
    axes : Axes, optional
    bins : int
        Bins have equal lengths; equal ratios when the gaps spread over more than a factor of 50.

    Returns
    -------
    Axes

    Raises
    ------
    InputError
        When there is no gap at all.
    """
    axes = ready(axes)
    families = _families(gaps, lambda run: run.gaps[1:], "gaps")
    every = np.concatenate(list(families.values()))
    low, high = float(every.min()), float(every.max())
    logarithmic = low > 0 and high > 50 * low
    if logarithmic:
        axes.set_xscale("log")
        edges = np.geomspace(low / 1.02, high * 1.02, bins + 1)
    else:
        edges = np.linspace(0.0, 1.02 * high if high > 0 else 1.0, bins + 1)
    for k, (name, values) in enumerate(families.items()):
        shares = np.histogram(values, edges)[0] / len(values)
        look = style(k)
        axes.stairs(shares, edges, color=look["color"], alpha=0.12, fill=True)
        text = f"{name}: {len(values)} gaps, median {np.median(values):.3g} s"
        axes.stairs(shares, edges, color=look["color"], linestyle=look["linestyle"], linewidth=1.6, label=text)
    axes.set_xlabel("gap between samples [s]")
    axes.set_ylabel("share of gaps")
    axes.set_ylim(bottom=0.0)
    above_legend(axes)
    return axes


def plot_solve_times(seconds: Any, axes: Any = None) -> Any:
    """Draw the share of solves that took no longer than a time, median and 99th percentile marked.

    Parameters
    ----------
    seconds : runs or seconds, or mapping label -> runs or seconds
        A `Run`, several, or an array of solve times.
    axes : Axes, optional

    Returns
    -------
    Axes

    Raises
    ------
    InputError
        When there is no solve at all.
    """
    axes = ready(axes)
    families = _families(seconds, lambda run: run.solve_seconds, "solve times")
    for k, (name, values) in enumerate(families.items()):
        ordered = 1e3 * np.sort(values)
        median, late = np.quantile(ordered, [0.5, 0.99], method="inverted_cdf")
        look = style(k)
        text = f"{name}: median {median:.3g} ms, 99 % within {late:.3g} ms"
        marker = look.pop("marker")
        axes.plot(ordered, np.arange(1, len(ordered) + 1) / len(ordered), **look, linewidth=1.6, drawstyle="steps-post")
        axes.plot([median, late], [0.5, 0.99], color=look["color"], marker=marker, linestyle="none")
        axes.plot([], [], **look, marker=marker, linewidth=1.6, label=text)
    for share, text in ((0.5, "median"), (0.99, "99 %")):
        axes.axhline(share, color="#888888", linewidth=0.7, linestyle=":")
        axes.annotate(text, (1.01, share), xycoords=("axes fraction", "data"), va="center", fontsize=SMALL)
    axes.set_xscale("log")
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel("solve time [ms]")
    axes.set_ylabel("share of solves")
    above_legend(axes)
    return axes


def _families(data: Any, of_run: Any, what: str) -> dict[str, Array]:
    """Return label -> values, families without values left out."""
    named = data if isinstance(data, Mapping) else {"all": data}
    families = {}
    for name, given in named.items():
        if hasattr(given, "dataset"):
            values = of_run(given)
        elif isinstance(given, (list, tuple)) and given and hasattr(given[0], "dataset"):
            values = np.concatenate([of_run(run) for run in given])
        else:
            values = np.asarray(given, dtype=float).reshape(-1)
        values = values[np.isfinite(values)]
        if len(values):
            families[str(name)] = values
    if not families:
        raise InputError(f"plot: no {what} to draw in {', '.join(map(str, named)) or 'an empty mapping'}")
    return families
