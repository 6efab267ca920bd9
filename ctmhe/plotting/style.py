"""How figures look: colours, markers, lines, legends, and the names of what is drawn."""

from __future__ import annotations

from typing import Any

from ctmhe.errors import MissingExtra

# Okabe and Ito without the yellow, which is lost on white; the order alternates dark and light for grey prints.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
LINES: tuple[Any, ...] = ("-", (0, (5, 1.6)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)), (0, (3, 1.2)))
SMALL = 9.0
"""Points of the smallest letters."""
WIDTH = 7.2
"""Inches of a figure: a printed page without its margins."""
LETTERS = 100
"""How many letters of that size, gaps included, stand in one line of a legend."""

NAMES = {
    "samples": "samples",
    "solves": "solves",
    "messages": "messages",
    "messages_lost": "messages lost",
    "bytes_sent": "bytes sent",
    "measurements": "measurements delivered",
    "too_late": "measurements too late",
    "online_rms": "online RMS error",
    "retrospective_rms": "retrospective RMS error",
    "ise": "integrated squared error",
    "longest_gap": "longest gap [s]",
    "shortest_gap": "shortest gap [s]",
    "solve_ms_median": "median solve time [ms]",
    "solve_ms_max": "longest solve time [ms]",
    "solve_seconds_total": "time in solves [s]",
    "failed_solves": "failed solves",
    "seconds": "time of the run [s]",
}


def title(name: str) -> str:
    """Return a metric's name for people, with its unit where it has one of its own."""
    metric, dot, signal = name.partition(".")
    return f"{NAMES.get(metric, metric)} of {signal}" if dot and metric in NAMES else NAMES.get(name, name)


def style(k: int) -> dict[str, Any]:
    """Return colour, marker and line of the `k`-th family."""
    return {
        "color": COLOURS[k % len(COLOURS)],
        "marker": MARKERS[k % len(MARKERS)],
        "linestyle": LINES[k % len(LINES)],
    }


def ready(axes: Any = None, size: tuple[float, float] = (WIDTH, 4.0)) -> Any:
    """Return the Axes, new ones where none are given, with the grid and without the frame."""
    if axes is None:
        try:
            from matplotlib import pyplot
        except ImportError as error:
            raise MissingExtra("matplotlib", "plot", "Drawing") from error
        axes = pyplot.subplots(figsize=size, layout="constrained")[1]
    axes.grid(visible=True, color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def above_legend(axes: Any, columns: int | None = None) -> None:
    """Put the legend above the Axes, where it hides nothing, in as many columns as the labels leave room for."""
    labels = axes.get_legend_handles_labels()[1]
    if not labels:
        return
    if columns is None:
        columns = max(1, min(len(labels), 4, LETTERS // (max(map(len, labels)) + 8)))
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        frameon=False,
        fontsize=SMALL,
        borderaxespad=0.1,
        handlelength=2.4,
        columnspacing=1.2,
    )


def scale(axes: Any, values: Any, which: str) -> None:
    """Scale the axis `which` ("x" or "y") for what has been drawn.

    Logarithmic when positive values spread over more than a factor of 20; from zero when zero is not far.
    """
    low, high = float(min(values)), float(max(values))
    if low > 0 and high > 20 * low:
        getattr(axes, f"set_{which}scale")("log")
    elif 0 <= low < 0.5 * high:
        getattr(axes, f"set_{which}lim")(**{"left" if which == "x" else "bottom": 0.0})
