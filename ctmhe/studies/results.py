"""Results of studies: the table, means with confidence intervals, differences pair by pair."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.statistics import interval
from ctmhe.studies.store import Row, Store, finished

if TYPE_CHECKING:
    import pandas as pd

    from ctmhe.simulation.run import Run


@dataclass(frozen=True, eq=False)
class StudyResult:
    """The runs of a study.

    Attributes
    ----------
    table : DataFrame
        One row a run, in the order of the design: the parameters' labels, `seed`, the metrics, `error` ("" for none),
        `seconds` (wall-clock time of the run), `key`.
    parameters, metrics : tuple of str
        Names of columns.
    name : str
    """

    table: pd.DataFrame
    parameters: tuple[str, ...]
    metrics: tuple[str, ...]
    name: str = "study"
    store: Store | None = None

    @property
    def failed(self) -> pd.DataFrame:
        """The runs that ended with an error."""
        return self.table.loc[self.table["error"] != ""]

    @classmethod
    def load(cls, folder: str | Path) -> StudyResult:
        """Read the finished runs of a study from its folder alone.

        Raises
        ------
        InputError
            If there is no study.
        """
        store = Store(folder)
        about = store.need_about()
        parameters, seeds = tuple(about["parameters"]), about["seeds"]
        rows = finished(store, about["keys"], bool(about["trajectories"]))
        ordered = []
        for i, key in enumerate(about["keys"]):
            if key in rows:
                point = dict(zip(parameters, about["points"][i // len(seeds)], strict=True))
                ordered.append(rows[key] | point)
        return make_table(ordered, parameters, about["metrics"], about["name"], store)

    def summary(self, metric: str, by: str | Sequence[str] | None = None, *, confidence: float = 0.95) -> pd.DataFrame:
        """Return mean and confidence interval of a metric for each point.

        Parameters
        ----------
        metric : str
        by : str or sequence of str, optional
            Parameters that make the groups; all when left out.
        confidence : float
            Of the interval for the mean, after Student's t.

        Returns
        -------
        DataFrame
            Columns: `by`, `n` (runs with a value), `failed` (runs without), `mean`, `sd`, `low`, `high`; in the order
            of the design. The interval is NaN for a single run.
        """
        self._check_metric(metric)
        by = self._columns(by)
        rows = []
        for labels, group in _groups(self.table, by):
            values = group[metric].to_numpy(dtype=float)
            known = values[~np.isnan(values)]
            mean, sd, low, high = interval(known, confidence)
            about = {"n": len(known), "failed": len(values) - len(known)}
            rows.append({**labels, **about, "mean": mean, "sd": sd, "low": low, "high": high})
        import pandas as pd

        return pd.DataFrame(rows)

    def means(self, *metrics: str) -> pd.DataFrame:
        """Return the means of several metrics, one row a point; NaN where all of its runs failed.

        Columns: the parameters, then `metrics`. What `pareto_front` takes.
        """
        for metric in metrics:
            self._check_metric(metric)
        import pandas as pd

        groups = _groups(self.table, self.parameters)
        return pd.DataFrame([{**labels, **{m: group[m].mean() for m in metrics}} for labels, group in groups])

    def compare(
        self,
        metric: str,
        baseline: Any,
        *,
        by: str | Sequence[str] | None = None,
        confidence: float = 0.95,
        higher_is_better: bool = False,
    ) -> pd.DataFrame:
        """Return the differences of a metric to a baseline, pair by pair: the same seed, the other parameters the same.

        Parameters
        ----------
        metric : str
        baseline : mapping parameter -> label, or a label
            What to compare with, such as `{"policy": "even"}`; a label alone where one parameter only has it.
        by : str or sequence of str, optional
            Parameters that make a row, all when left out: with `by="policy"` the pairs of all other parameters count
            together.
        confidence : float
            Of the interval for the mean difference, after Student's t.
        higher_is_better : bool

        Returns
        -------
        DataFrame
            One row a point that is not the baseline: `by`, `n` (pairs), `dropped` (pairs of which a run has
            no value), `difference` (mean of point minus baseline), `low`, `high`, `ratio` (mean over baseline mean),
            `better` (share of pairs in which the point is better).
        """
        self._check_metric(metric)
        chosen = self._baseline(baseline)
        rest = [name for name in self.parameters if name not in chosen]
        is_base = np.logical_and.reduce([self.table[name] == label for name, label in chosen.items()])
        values = self.table[metric].to_numpy(dtype=float)
        at = self.table[[*rest, "seed"]].itertuples(index=False, name=None)
        keys = list(at)
        base = {keys[i]: values[i] for i in np.flatnonzero(is_base)}
        rows = []
        for labels, group in _groups(self.table.loc[~is_base], self._columns(by)):
            mine = values[group.index]
            other = np.array([base.get(keys[i], np.nan) for i in group.index])
            both = ~(np.isnan(mine) | np.isnan(other))
            gap = (mine - other)[both]
            mean, _, low, high = interval(gap, confidence)
            better = gap > 0 if higher_is_better else gap < 0
            about = {"n": int(both.sum()), "dropped": int((~both).sum()), "difference": mean, "low": low, "high": high}
            divisor = other[both].mean() if both.any() else 0.0
            about["ratio"] = mine[both].mean() / divisor if divisor else np.nan
            rows.append({**labels, **about, "better": better.mean() if both.any() else np.nan})
        import pandas as pd

        return pd.DataFrame(rows)

    def run(self, row: Any) -> Run:
        """Return the kept trajectory of a run.

        Parameters
        ----------
        row : int or Series
            A row of `table`, or its number.

        Raises
        ------
        InputError
            When the study has no folder, or the run left no trajectory.
        """
        from ctmhe.studies.trajectories import read_trajectory

        if self.store is None:
            raise InputError("study: it has no folder, so that no trajectory was kept (folder=, trajectories=True)")
        about = self.table.iloc[row] if isinstance(row, (int, np.integer)) else row
        if about["error"]:
            raise InputError(f"study: this run failed: {about['error']}")
        return read_trajectory(self.store.trajectory_path(about["key"]))

    def __repr__(self) -> str:
        failed = len(self.failed)
        rows = [f"StudyResult of {self.name!r}: {len(self.table)} runs" + f", {failed} failed" * bool(failed)]
        rows.append(f"  parameters: {', '.join(self.parameters) or 'none'}")
        rows.append(f"  metrics: {', '.join(self.metrics) or 'none'}")
        return "\n".join(rows)

    def _columns(self, by: str | Sequence[str] | None) -> tuple[str, ...]:
        """Return the parameters that make a row, all of them for None."""
        by = self.parameters if by is None else (by,) if isinstance(by, str) else tuple(by)
        for name in by:
            _check(name, self.parameters, "parameter")
        return by

    def _check_metric(self, metric: str) -> None:
        _check(metric, self.metrics, "metric")
        if not all(isinstance(value, (bool, int, float, np.number, np.bool_)) for value in self.table[metric].dropna()):
            raise InputError(f"metric {metric!r} is text; only numbers have a mean")

    def _baseline(self, baseline: Any) -> dict[str, Any]:
        """Return the parameters and labels that make the baseline."""
        if not isinstance(baseline, Mapping):
            having = [name for name in self.parameters if (self.table[name] == baseline).any()]
            if len(having) > 1:
                raise InputError(f"label {baseline!r} is one of {' and of '.join(having)}; give {{parameter: label}}")
            if not having:
                known = [label for name in self.parameters for label in self.table[name].unique()]
                _check(baseline, known, "label")
            baseline = {having[0]: baseline}
        if not baseline:
            raise InputError("compare: the baseline names no parameter; give {parameter: label}")
        for name, label in baseline.items():
            _check(name, self.parameters, "parameter")
            _check(label, list(self.table[name].unique()), f"label of {name}:")
        return dict(baseline)


def make_table(
    rows: Sequence[Row], parameters: tuple[str, ...], metrics: Sequence[str] | None, name: str, store: Store | None
) -> StudyResult:
    """Return the result that rows make, which are in the order of the design.

    Raises
    ------
    InputError
        When a wanted metric is in no row.
    """
    import pandas as pd

    around = (*parameters, "seed", "error", "seconds", "key")
    found = list(dict.fromkeys(column for row in rows for column in row if column not in around))
    if metrics is not None and any(not row["error"] for row in rows):
        for metric in metrics:
            _check(metric, found, "metric")
    wanted = tuple(found if metrics is None else metrics)
    columns = [*parameters, "seed", *wanted, "error", "seconds", "key"]
    table = pd.DataFrame(list(rows), columns=columns)
    for metric in wanted:
        kinds = {isinstance(value, str) for value in table[metric].dropna()}
        if len(kinds) > 1:  # a column is numbers or text
            table[metric] = table[metric].map(str, na_action="ignore")
    return StudyResult(table, parameters, wanted, name, store)


def _groups(table: pd.DataFrame, by: Sequence[str]) -> Iterable[tuple[dict[str, Any], pd.DataFrame]]:
    """Return labels and rows of each group, in the order in which the groups appear."""
    if not by:
        return [({}, table)]
    groups = table.groupby(list(by), sort=False)
    return [(dict(zip(by, labels, strict=True)), group) for labels, group in groups]  # pyright: ignore


def _check(name: Any, known: Sequence[Any], what: str) -> None:
    if name not in known:
        near = get_close_matches(str(name), [str(item) for item in known], n=1)
        hint = f"; did you mean {near[0]!r}?" if near else "."
        raise InputError(f"unknown {what} {name!r}{hint} Known: {', '.join(map(str, known)) or 'none'}")
