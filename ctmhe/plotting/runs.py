"""Figures of one run: states with their estimates, outputs with their samples, the trigger's level, the gaps."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.errors import InputError, MissingExtra
from ctmhe.plotting.style import SMALL, WIDTH, above_legend, ready
from ctmhe.types import Array

STYLES: dict[str, dict[str, Any]] = {
    "x_true": {"color": "#000000", "linestyle": "-", "linewidth": 1.1, "label": "true", "zorder": 3},
    "x_online": {"color": "#D55E00", "linestyle": "-", "linewidth": 2.6, "alpha": 0.6, "label": "online estimate"},
    "x_retro": {
        "color": "#0072B2",
        "linestyle": (0, (4, 1.6)),
        "linewidth": 1.6,
        "label": "retrospective estimate",
        "zorder": 4,
    },
}
MEASURED: dict[str, Any] = {"color": "#999999", "linewidth": 0.7, "label": "measured"}
SAMPLED: dict[str, Any] = {
    "color": "#009E73",
    "marker": "o",
    "markersize": 3.2,
    "linestyle": "none",
    "label": "sampled",
}
LEVEL = "#CC79A7"
PANEL = (WIDTH, 1.7)
"""Width and height of one panel in inches."""


def plot_run(dataset: Any, axes: Any = None) -> Any:
    """Draw a run: every state with its estimates, every output with its samples, the trigger's level, the gaps.

    Parameters
    ----------
    dataset : xarray.Dataset
        `Run.dataset`.
    axes : array of Axes, optional
        One for each state, one for each output, one for the level of a run that has one, one for the gaps, in this
        order. Made when left out.

    Returns
    -------
    array of Axes
        In that order; `axes[0].figure` is the figure.

    Raises
    ------
    MissingExtra
        When matplotlib is not installed.
    InputError
        When there are too few axes.
    """
    states = [str(name) for name in dataset["state"].to_numpy()]
    outputs = [str(name) for name in dataset["output"].to_numpy()]
    level = has_level(dataset)
    needed = len(states) + len(outputs) + level + 1
    if axes is None:
        axes = make_panels(needed)
    axes = np.atleast_1d(np.asarray(axes, dtype=object)).reshape(-1)
    if len(axes) < needed:
        parts = f"{len(states)} states, {len(outputs)} outputs, {'level, ' if level else ''}gaps"
        raise InputError(f"plot: {needed} axes are needed for {parts}; got {len(axes)}")
    for i, name in enumerate(states):
        plot_state(dataset, name, axes[i])
    for i, name in enumerate(outputs):
        plot_output(dataset, name, axes[len(states) + i])
    if level:
        plot_level(dataset, axes[needed - 2])
    plot_gaps(dataset, axes[needed - 1])
    for panel in (axes[0], axes[len(states)]):
        above_legend(panel, columns=4)
    return axes[:needed]


def plot_state(dataset: Any, name: str, axes: Any) -> Any:
    """Draw one state: true, online and retrospective, with ticks at the sampling instants; return the Axes."""
    t = dataset["time"].to_numpy()
    for variable in ("x_online", "x_true", "x_retro"):
        values = dataset[variable].sel(state=name).to_numpy()
        if not np.isnan(values).all():
            axes.plot(t, values, **STYLES[variable])
    mark_samples(dataset["sample_time"].to_numpy(), axes)
    axes.set_ylabel(label(dataset, "state", name))
    axes.set_xlim(t[0], t[-1])
    return axes


def plot_output(dataset: Any, name: str, axes: Any) -> Any:
    """Draw one measured output and its samples; return the Axes."""
    t = dataset["time"].to_numpy()
    axes.plot(t, dataset["y"].sel(output=name).to_numpy(), **MEASURED)
    axes.plot(dataset["sample_time"].to_numpy(), dataset["y_sampled"].sel(output=name).to_numpy(), **SAMPLED)
    axes.set_ylabel(label(dataset, "output", name))
    axes.set_xlim(t[0], t[-1])
    return axes


def has_level(dataset: Any) -> bool:
    """Return whether the trigger of a run had a level."""
    return "level" in dataset and bool(np.isfinite(dataset["level"].to_numpy()).any())


def plot_level(dataset: Any, axes: Any) -> Any:
    """Draw the trigger's level, infinite values on the edge: it samples where zero is reached; return the Axes."""
    t, level = dataset["time"].to_numpy(), dataset["level"].to_numpy()
    finite = level[np.isfinite(level)]
    low, high = min(0.0, *finite), max(0.0, *finite)
    margin = 0.08 * (high - low) or 1.0
    axes.plot(t, np.clip(level, low - margin, high + margin), color=LEVEL, linewidth=1.1)
    axes.axhline(0.0, color="#000000", linewidth=0.9, linestyle=(0, (4, 2)))
    mark_samples(dataset["sample_time"].to_numpy(), axes)
    axes.set_ylim(low - 1.2 * margin, high + 1.2 * margin)
    axes.set_xlim(t[0], t[-1])
    axes.set_ylabel("level")
    return axes


def plot_gaps(dataset: Any, axes: Any) -> Any:
    """Draw the time between samples at every sample; return the Axes."""
    t, times, gaps = (dataset[key].to_numpy() for key in ("time", "sample_time", "gap"))
    if len(times):
        axes.vlines(times, 0.0, gaps, color=SAMPLED["color"], linewidth=0.9)
        axes.plot(times, gaps, **{**SAMPLED, "label": "gap"})
    axes.set_ylim(bottom=0.0, top=1.1 * float(gaps.max()) if len(gaps) and gaps.max() > 0 else 1.0)
    axes.set_xlim(t[0], t[-1])
    axes.set_ylabel("gap [s]")
    axes.annotate(
        f"{len(times)} samples", (1.0, 1.02), xycoords="axes fraction", ha="right", va="bottom", fontsize=SMALL
    )
    return axes


def mark_samples(times: Array, axes: Any) -> Any:
    """Put a tick at every sampling instant along the lower edge; return the Axes."""
    axes.vlines(
        times, 0.0, 0.06, transform=axes.get_xaxis_transform(), color=SAMPLED["color"], linewidth=0.9, label="sample"
    )
    return axes


def label(dataset: Any, kind: str, name: str) -> str:
    """Return `name [unit]`."""
    unit = str(dataset[f"{kind}_unit"].sel({kind: name}).item())
    return f"{name} [{unit}]" if unit else name


def make_panels(count: int) -> Any:
    """Return `count` Axes over a common time axis: one column, two from eight panels on."""
    try:
        from matplotlib import pyplot
    except ImportError as error:
        raise MissingExtra("matplotlib", "plot", "Drawing a run") from error
    columns = 1 if count < 8 else 2
    rows = -(-count // columns)
    size = (PANEL[0] * (1.0 if columns == 1 else 1.6), 0.5 + PANEL[1] * rows)
    figure, grid = pyplot.subplots(rows, columns, figsize=size, sharex=True, squeeze=False, layout="constrained")
    panels = grid.T.reshape(-1)
    for axes in panels[count:]:
        axes.set_visible(False)
    last = {rows - 1, count - 1} if columns == 2 else {count - 1}
    for i in last:
        panels[i].set_xlabel("time [s]")
        panels[i].tick_params(labelbottom=True)
    for axes in panels[:count]:
        ready(axes)
    for column in grid.T:
        figure.align_ylabels(column)
    return panels[:count]
