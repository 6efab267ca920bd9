"""Studies: one case, many points, the same seeds for each."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.studies.design import RESERVED, Design, Label, as_design, named
from ctmhe.studies.execution import Outcome, Task, execute
from ctmhe.studies.keys import describe, digest
from ctmhe.studies.results import StudyResult, make_table
from ctmhe.studies.store import Row, Status, Store, finished, status_of

log = logging.getLogger(__name__)


class Study:
    """A case that is run at every point of a design with every seed.

    All points meet the same seeds, so that they can be compared pair by pair. With a folder every finished run is kept
    under a key that stands for everything it depends on (see `ctmhe.studies.keys`): a study that was stopped goes on
    where it was, an extended one runs what is new only, and what a changed case makes stale is run again.

    Parameters
    ----------
    case : callable (*, seed, **parameters) -> Run, mapping name -> number, or a pair of both
        Has to depend on its arguments alone. For runs elsewhere it is pickled (by cloudpickle, so that functions of a
        notebook will do), with all it refers to.
    grid : mapping parameter -> values, sequence of mappings, DataFrame or Design
        See `full_grid` for mappings; a sequence or DataFrame is a table of points.
    seeds : int or sequence of int
        A number n stands for 0, ..., n - 1.
    design : Design, optional
        Such as `latin_hypercube(...)`; combined with every point of `grid`.
    folder : path, optional
        Where results are kept. Workers write trajectories there: it has to be a folder that all of them see.
    name : str, optional
        The case's when left out.
    metrics : sequence of str, optional
        Columns of the table; all that the case returns (see `metrics_of`) when left out.
    trajectories : bool
        Keep the trajectory of every run, see `StudyResult.run`.
    version : str
        Part of the key, for what no key can see: a data file, a library of your own in another language.

    Raises
    ------
    InputError
        For a case that does not take these parameters, a design or seeds that are none, a folder that is missing or
        holds another study.

    Examples
    --------
    >>> def case(*, seed, gain):
    ...     return {"cost": gain + 0.1 * seed}
    >>> result = Study(case, {"gain": [1.0, 2.0]}, seeds=3).run()
    >>> float(result.table["cost"].max())
    2.2
    """

    def __init__(
        self,
        case: Callable[..., Any],
        grid: Any = None,
        seeds: int | Iterable[int] = range(20),
        *,
        design: Design | None = None,
        folder: str | Path | None = None,
        name: str | None = None,
        metrics: Sequence[str] | None = None,
        trajectories: bool = False,
        version: str = "",
    ):
        self.case = case
        self.design = as_design({} if grid is None else grid)
        if design is not None:
            self.design = self.design * as_design(design)
        self.seeds = _seeds(seeds)
        _check_case(case, self.design)
        self.name = name or _case_name(case).rpartition(".")[2]
        self.metrics = (metrics,) if isinstance(metrics, str) else None if metrics is None else tuple(metrics)
        self.trajectories, self.version = bool(trajectories), str(version)
        self.store = None if folder is None else Store(folder)
        if self.store is None and self.trajectories:
            raise InputError("study: trajectories=True needs folder=, where they are kept")
        self._keys = self._make_keys()
        if self.store is not None:
            self._check_folder(self.store)

    def run(
        self, workers: int = 1, executor: Any = None, progress: bool = False, *, retry_failed: bool = False
    ) -> StudyResult:
        """Do the runs that are missing, and return all.

        A run that raises is a row with its error; so is one whose process dies, twice.

        Parameters
        ----------
        workers : int
            1: in this process. More: that many processes (joblib's loky).
        executor : concurrent.futures.Executor or dask.distributed.Client, optional
            In place of processes of our own.
        progress : bool
            Show a bar with rate and time left.
        retry_failed : bool
            Do again the runs that ended with an error.

        Returns
        -------
        StudyResult

        Raises
        ------
        InputError
            For a case or a value that cannot be sent to another process, before anything starts.
        """
        if isinstance(workers, bool) or not isinstance(workers, (int, np.integer)) or workers < 1:
            raise InputError(f"study: workers must be a whole number of at least 1, got {workers!r}")
        rows: dict[str, Row] = {}
        if self.store is not None:
            rows = finished(self.store, list(self._keys), self.trajectories)
            stale = self.store.stale(self._keys)
            if stale and not rows:
                log.warning("study %r: the case has changed; %d kept runs are stale and not used", self.name, stale)
            if retry_failed:
                rows = {key: row for key, row in rows.items() if not row["error"]}
        tasks = [task for task in self._tasks() if task.key not in rows]
        outcomes = execute(self.case, self.design, tasks, workers=int(workers), executor=executor)
        if self.store is not None:
            self.store.write_about(self._about())
        bar = _bar(progress, len(self._keys), len(rows), self.name)
        try:
            for task, outcome in outcomes:
                row = self._row(task, outcome)
                if self.store is not None:
                    self.store.write(row)
                rows[task.key] = row
                bar.update()
        finally:
            outcomes.close()
            bar.close()
        result = self._result(rows)
        if self.store is not None:
            self.store.write_table(result.table)
        return result

    def result(self) -> StudyResult:
        """Return the runs that are finished, without doing any."""
        store = self._need_folder("result")
        return self._result(finished(store, list(self._keys), self.trajectories))

    def status(self) -> Status:
        """Return how many runs are done, failed, missing and stale."""
        return status_of(self._need_folder("status"), list(self._keys), self.trajectories)

    def repeat(self, row: Any) -> Any:
        """Do a run of the table again, here, and return what the case returns: an error comes with its traceback.

        Parameters
        ----------
        row : int or Series
            A row of `StudyResult.table`, or its number.
        """
        task = list(self._keys.values())[row] if isinstance(row, (int, np.integer)) else self._keys[row["key"]]
        return self.case(seed=task.seed, **list(self.design)[task.point])

    def __len__(self) -> int:
        return len(self._keys)

    def __repr__(self) -> str:
        rows = [f"Study {self.name!r}: {len(self.design)} points, {len(self.seeds)} seeds, {len(self)} runs"]
        for i, name in enumerate(self.design.parameters):
            values = list(dict.fromkeys(str(row[i]) for row in self.design.labels))
            shown = ", ".join(values[:6]) + (f", ... ({len(values)})" if len(values) > 6 else "")
            rows.append(f"  {name}: {shown}")
        return "\n".join(rows)

    def _make_keys(self) -> dict[str, Task]:
        """Return the runs in the order of the table, by key."""
        from ctmhe import __version__

        common = digest(self.case, __version__, self.version)
        keys: dict[str, Task] = {}
        rows = zip(self.design.labels, self.design.values, strict=True)
        for point, (labels, values) in enumerate(rows):
            named_so = [f"{name}={_stable(label)}" for name, label in zip(self.design.parameters, labels, strict=True)]
            here = digest(common, *sorted(named_so), *map(describe, values))
            for seed in self.seeds:
                key = digest(here, str(seed))
                kept = None
                if self.store is not None and self.trajectories:
                    kept = str(self.store.trajectory_path(key).absolute())
                keys[key] = Task(key, point, seed, kept)
        return keys

    def _tasks(self) -> list[Task]:
        """Return the runs in the order in which they are done: one seed at all points, then the next."""
        order = {seed: i for i, seed in enumerate(self.seeds)}
        return sorted(self._keys.values(), key=lambda task: (order[task.seed], task.point))

    def _row(self, task: Task, outcome: Outcome) -> Row:
        values, error = outcome.values, outcome.error
        taken = [name for name in values if name in (*RESERVED, *self.design.parameters)]
        if taken:
            values, error = {}, f"InputError: a metric cannot be called {taken[0]!r}: the table has such a column"
        return self._labelled(task, {**values, "error": error, "seconds": outcome.seconds, "key": task.key})

    def _labelled(self, task: Task, row: Row) -> Row:
        """Return a row with the labels as they are now: a column of whole numbers may have become one of numbers."""
        labels = dict(zip(self.design.parameters, self.design.labels[task.point], strict=True))
        return row | labels | {"seed": task.seed}

    def _result(self, rows: Mapping[str, Row]) -> StudyResult:
        ordered = [self._labelled(task, rows[key]) for key, task in self._keys.items() if key in rows]
        return make_table(ordered, self.design.parameters, self.metrics, self.name, self.store)

    def _about(self) -> dict[str, Any]:
        from ctmhe import __version__

        return {
            "name": self.name,
            "case": _case_name(self.case),
            "ctmhe": __version__,
            "version": self.version,
            "parameters": self.design.parameters,
            "points": self.design.labels,
            "seeds": self.seeds,
            "metrics": self.metrics,
            "trajectories": self.trajectories,
            "keys": list(self._keys),
        }

    def _check_folder(self, store: Store) -> None:
        """Raise unless the folder is new, or its study is this one or a part of it."""
        about = store.read_about()
        if about is None:
            return
        where = f"study: {str(store.folder)!r} holds"
        if about["case"] != _case_name(self.case):
            raise InputError(f"{where} runs of {about['case']}, not of {_case_name(self.case)}; choose another folder")
        if set(about["parameters"]) != set(self.design.parameters):
            old, new = (", ".join(names) or "none" for names in (about["parameters"], self.design.parameters))
            raise InputError(f"{where} a study over the parameters {old}, not {new}; choose another folder")
        order = [about["parameters"].index(name) for name in self.design.parameters]
        points = [tuple(point[i] for i in order) for point in about["points"]]
        for point in points:
            if point not in set(self.design.labels):
                raise InputError(
                    f"{where} a study with the point {named(self.design.parameters, point)}, which this design lacks. "
                    "A folder's study can be extended, not changed: keep its points, or choose another folder"
                )
        if not set(about["seeds"]) <= set(self.seeds):
            gone = sorted(set(about["seeds"]) - set(self.seeds))
            raise InputError(f"{where} a study with seed {gone[0]}, which is not among these seeds: {_few(self.seeds)}")

    def _need_folder(self, what: str) -> Store:
        if self.store is None:
            raise InputError(f"study: {what}() reads the folder of a study; this one has none (folder=)")
        return self.store


def _stable(label: Label) -> str:
    """Return a label as it goes into a key: 1 and 1.0 are one."""
    return repr(float(label)) if isinstance(label, (int, float)) and not isinstance(label, bool) else str(label)


def _case_name(case: Callable[..., Any]) -> str:
    case = getattr(case, "func", case)  # of a partial
    kind = case if hasattr(case, "__qualname__") else type(case)
    return f"{kind.__module__}.{kind.__qualname__}"


def _seeds(seeds: int | Iterable[int]) -> tuple[int, ...]:
    listed = range(int(seeds)) if isinstance(seeds, (int, np.integer)) and not isinstance(seeds, bool) else seeds
    if not isinstance(listed, Iterable) or isinstance(listed, (str, bytes, Mapping)):
        raise InputError(f"study: seeds must be whole numbers, or how many, got {seeds!r}")
    numbers = list(listed)
    for seed in numbers:
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise InputError(f"study: seeds must be whole numbers of at least 0, got {seed!r}")
    if not numbers or len(set(numbers)) < len(numbers):
        raise InputError(f"study: seeds must be different numbers, at least one, got {_few(numbers)}")
    return tuple(int(seed) for seed in numbers)


def _few(values: Sequence[Any]) -> str:
    shown = ", ".join(map(str, values[:8]))
    return f"{shown}, ... ({len(values)})" if len(values) > 8 else shown or "none"


def _check_case(case: Callable[..., Any], design: Design) -> None:
    """Raise unless the case can be called with `seed` and the design's parameters."""
    if not callable(case):
        raise InputError(f"study: the case must be a function of seed and the parameters, got {case!r}")
    try:
        signature = inspect.signature(case)
    except (TypeError, ValueError):  # built-in: it will tell
        return
    try:
        signature.bind(seed=0, **dict.fromkeys(design.parameters))
    except TypeError as error:
        names = ", ".join(["seed", *design.parameters])
        raise InputError(f"study: the case {_case_name(case)}{signature} does not take ({names}): {error}") from None


class _Quiet:
    def update(self) -> None:
        """Show nothing."""

    def close(self) -> None:
        """Show nothing."""


def _bar(progress: bool, total: int, done: int, name: str) -> Any:
    if not progress:
        return _Quiet()
    from tqdm import tqdm

    return tqdm(total=total, initial=done, desc=name, unit="run")
