"""Searching a space of parameters for several goals at once: Optuna proposes, studies judge."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.errors import InputError, MissingExtra
from ctmhe.studies.design import Design, Label, bounds_of, full_grid
from ctmhe.studies.study import Study
from ctmhe.studies.tuning import pareto_front
from ctmhe.types import names_of

if TYPE_CHECKING:
    import pandas as pd

SAMPLERS = ("tpe", "nsga2")
AIMS = {"minimise": "minimize", "maximise": "maximize"}  # ours, and Optuna's


@dataclass(frozen=True, eq=False)
class Exploration:
    """What `explore` tried.

    Attributes
    ----------
    table : DataFrame
        One row a point, in the order of the search: the parameters, and the means of the objectives over the seeds.
    front : DataFrame
        The points that no other beats.
    runs : DataFrame
        One row a run, as `StudyResult.table`.
    """

    table: pd.DataFrame
    front: pd.DataFrame
    runs: pd.DataFrame


def explore(
    case: Callable[..., Any],
    space: Mapping[str, Any],
    objectives: str | Sequence[str] | Mapping[str, str],
    *,
    trials: int = 60,
    seeds: int | Iterable[int] = range(5),
    seed: int = 0,
    log: Sequence[str] = (),
    sampler: str = "tpe",
    batch: int = 10,
    workers: int = 1,
    executor: Any = None,
    folder: str | Path | None = None,
    progress: bool = False,
) -> Exploration:
    """Search a space for points that are good in several metrics at once.

    Points are proposed in batches and judged by their means over the same seeds. The same `seed` tries the same points,
    whatever the number of workers; with a folder, a search that was stopped goes on where it was.

    Parameters
    ----------
    case : callable
        As for `Study`.
    space : mapping parameter -> (low, high), list of values, or mapping label -> value
        A tuple is a range; a list or a mapping is a choice.
    objectives : names, or mapping metric -> "minimise" or "maximise"
        All minimised where no mapping is given.
    trials, batch : int
        Points in total, and at a time.
    seeds : int or sequence of int
        Of the runs.
    seed : int
        Of the search.
    log : sequence of str
        Ranges whose logarithm is searched.
    sampler : {"tpe", "nsga2"}
        Tree-structured Parzen estimators (Ozaki, Tanigaki, Watanabe, Onishi, GECCO 2020), or the genetic algorithm of
        Deb, Pratap, Agarwal, Meyarivan (2002) with generations of `batch` points, for hundreds of trials.
    workers, executor, folder, progress
        As for `Study` and `Study.run`.

    Raises
    ------
    MissingExtra
        When Optuna is not installed.
    InputError
        For a space, objectives or numbers that are none; when no run has a value for an objective.
    """
    try:
        import optuna
    except ImportError:
        raise MissingExtra("optuna", "tune", "explore") from None

    aims = dict(objectives) if isinstance(objectives, Mapping) else dict.fromkeys(names_of(objectives), "minimise")
    for metric, aim in aims.items():
        if aim not in AIMS:
            raise InputError(f"explore: {metric}: expected 'minimise' or 'maximise', got {aim!r}")
    if sampler not in SAMPLERS:
        raise InputError(f"explore: sampler must be one of {', '.join(SAMPLERS)}, got {sampler!r}")
    if min(trials, batch) < 1:
        raise InputError(f"explore: trials and batch must be at least 1, got {trials} and {batch}")
    ranges = {name: bounds_of(name, pair, name in log) for name, pair in space.items() if isinstance(pair, tuple)}
    choices = {name: _choice(name, values) for name, values in space.items() if name not in ranges}
    run = {"workers": workers, "executor": executor, "progress": progress}

    def suggest(trial: Any) -> tuple[Label, ...]:
        point = []
        for name in space:
            if name in ranges:
                point.append(trial.suggest_float(name, *ranges[name], log=name in log))
            else:
                point.append(trial.suggest_categorical(name, list(choices[name])))
        return tuple(point)

    def judge(points: list[tuple[Label, ...]], number: int) -> tuple[pd.DataFrame, pd.DataFrame]:
        values = tuple(
            tuple(choices[name][label] if name in choices else label for name, label in zip(space, point, strict=True))
            for point in points
        )
        here = None if folder is None else Path(folder) / f"batch-{number:04d}"
        design = Design(tuple(space), tuple(points), values)
        result = Study(case, design, seeds, folder=here, name=f"batch {number}").run(**run)
        if len(result.failed) == len(result.table):
            raise InputError(f"explore: every run of a batch failed, the first with {result.table['error'][0]}")
        return result.table, result.means(*aims)

    import pandas as pd

    tables: list[pd.DataFrame] = []
    means: dict[tuple[Label, ...], list[float]] = {}
    with _quiet(optuna):
        if sampler == "nsga2":
            chosen: Any = optuna.samplers.NSGAIISampler(population_size=max(batch, 2), seed=seed)
        else:
            chosen = optuna.samplers.TPESampler(seed=seed)
        search = optuna.create_study(directions=[AIMS[aim] for aim in aims.values()], sampler=chosen)  # type: ignore
        for number, first in enumerate(range(0, trials, batch)):
            asked = [search.ask() for _ in range(min(batch, trials - first))]
            points = [suggest(trial) for trial in asked]
            new = [point for point in dict.fromkeys(points) if point not in means]
            if new:
                table, judged = judge(new, number)
                tables.append(table)
                means |= dict(zip(new, judged[list(aims)].to_numpy(dtype=float).tolist(), strict=True))
            for trial, point in zip(asked, points, strict=True):
                if np.isnan(means[point]).any():
                    search.tell(trial, state=optuna.trial.TrialState.FAIL)
                else:
                    search.tell(trial, means[point])
    rows = [(*point, *values) for point, values in means.items()]
    found = pd.DataFrame(rows, columns=[*space, *aims])  # pyright: ignore
    minimised, maximised = ([metric for metric, aim in aims.items() if aim == which] for which in AIMS)
    return Exploration(found, pareto_front(found, minimised, maximised), pd.concat(tables, ignore_index=True))


def _choice(name: str, values: Any) -> dict[Label, Any]:
    design = full_grid({name: values})
    return {labels[0]: value[0] for labels, value in zip(design.labels, design.values, strict=True)}


@contextmanager
def _quiet(optuna: Any) -> Iterator[None]:
    """Keep Optuna from announcing its searches."""
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        yield
    finally:
        optuna.logging.set_verbosity(verbosity)
