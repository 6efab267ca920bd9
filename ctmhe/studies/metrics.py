"""Numbers that say what a run was worth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.simulation.run import Run

COUNTS = ("samples", "solves", "messages", "messages_lost", "bytes_sent", "measurements", "too_late")
TIMINGS = ("solve_ms_median", "solve_ms_max", "solve_seconds_total", "seconds")
"""What may differ between two runs of the same case with the same seed."""

Value = float | int | bool | str


def metrics_of(run: Run) -> dict[str, Value]:
    """Return the metrics of a run by name; NaN where the truth, or the count, is not known.

    `samples`, `solves`, `messages`, `messages_lost`, `bytes_sent`, `measurements`, `too_late` are counts. `online_rms`,
    `retrospective_rms`, `ise` and `online_rms.<state>` are the errors of `Run`. `longest_gap` counts from the start of
    the run, `shortest_gap` lies between samples, both in seconds. `solve_ms_median`, `solve_ms_max` and
    `solve_seconds_total` are wall-clock times, `failed_solves` the solves whose optimality conditions do not hold.
    """
    values: dict[str, Value] = {name: getattr(run, name, np.nan) for name in COUNTS}
    for name in ("online_rms", "retrospective_rms"):
        values[name] = _known(getattr(run, name))
    values["ise"] = _known(lambda: run.ise)
    for state in run.dataset["state"].to_numpy():
        values[f"online_rms.{state}"] = _known(lambda state=state: run.online_rms(str(state)))
    gaps, seconds = run.gaps, run.solve_seconds
    values["longest_gap"] = gaps.max() if len(gaps) else np.nan
    values["shortest_gap"] = gaps[1:].min() if len(gaps) > 1 else np.nan
    values["solve_ms_median"] = 1e3 * np.median(seconds) if len(seconds) else np.nan
    values["solve_ms_max"] = 1e3 * seconds.max() if len(seconds) else np.nan
    values["solve_seconds_total"] = seconds.sum()
    values["failed_solves"] = int(np.sum(~run.dataset["success"].to_numpy().astype(bool)))
    return {name: plain(name, value) for name, value in values.items()}


def read_answer(answer: Any) -> tuple[Run | None, dict[str, Value]]:
    """Return (run, metrics) of what a case returned: a `Run`, a mapping, or a pair of both.

    Raises
    ------
    InputError
        For anything else, and for a value that is neither a number nor text.
    """
    run, more = answer if isinstance(answer, tuple) and len(answer) == 2 else (answer, None)
    if isinstance(run, Mapping) and more is None:
        run, more = None, run
    if not (isinstance(run, Run) or run is None) or not (isinstance(more, Mapping) or more is None) or run is more:
        hint = " (is a return missing?)" if answer is None else ""
        raise InputError(
            f"the case returned {type(answer).__name__}{hint}; expected a Run, a mapping name -> number, or a pair of "
            "both"
        )
    values = {} if run is None else metrics_of(run)
    return run, values | {str(name): plain(str(name), value) for name, value in (more or {}).items()}


def plain(name: str, value: Any) -> Value:
    """Return a metric's value as Python's own number, boolean or text."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(()).item()
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (bool, int, float, str)):
        return float(value) if isinstance(value, int) and abs(value) >= 2**63 else value
    raise InputError(f"metric {name!r}: expected a number, a boolean or text, got {value!r}")


def _known(measure: Any) -> float:
    try:
        return measure()
    except InputError:  # the truth is not known
        return float("nan")
