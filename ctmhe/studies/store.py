"""The folder of a study: what it is about, one file a finished run, trajectories, and the table of everything.

    study.json                  case, design, seeds, keys in the order of the table
    runs/<key>.parquet          a finished run: one row
    trajectories/<key>.zarr.zip
    table.parquet               all rows, once the study is done

Every file is written beside its place and moved there, so that a process killed at any moment leaves whole files only.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from ctmhe.errors import InputError, MissingExtra

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

FORMAT = "ctmhe study 1"
PLAIN = {"compression": "none", "use_dictionary": False, "write_statistics": False}  # a row is too small for them

Row = dict[str, Any]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; what was written there takes its place in one step."""
    temporary = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@dataclass(frozen=True)
class Status:
    """How far a study is.

    Attributes
    ----------
    total, done, failed, missing : int
        Runs of the design; those finished, those of them that ended with an error, those not finished.
    stale : int
        Finished runs that belong to no run of the design: the case, or what it refers to, has changed since.
    rate : float
        Runs finished a second, over the last hundred; NaN where fewer than two are finished.
    seconds_left : float
        Missing runs at that rate.
    """

    total: int
    done: int
    failed: int
    missing: int
    stale: int
    rate: float

    @property
    def seconds_left(self) -> float:
        """Seconds until the study is done, at its last rate; NaN where that is not known."""
        return self.missing / self.rate if self.missing else 0.0

    def __repr__(self) -> str:
        more = f", {self.failed} failed" * bool(self.failed) + f", {self.stale} stale" * bool(self.stale)
        return f"{self.done} of {self.total} runs done, {self.missing} missing{more}"


class Store:
    """The files of a study."""

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)

    def run_path(self, key: str) -> Path:
        """Return the file of a finished run."""
        return self.folder / "runs" / f"{key}.parquet"

    def trajectory_path(self, key: str) -> Path:
        """Return the file of a run's trajectory."""
        return self.folder / "trajectories" / f"{key}.zarr.zip"

    def read_about(self) -> dict[str, Any] | None:
        """Return what `study.json` says, None where there is no such file.

        Raises
        ------
        InputError
            If it is not the file of a study that this version reads.
        """
        path = self.folder / "study.json"
        try:
            about = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise InputError(f"study: {path} cannot be read: {error}") from error
        if not isinstance(about, dict) or about.get("format") != FORMAT:
            raise InputError(f"study: {path} is not the file of a study that this version reads ({FORMAT!r})")
        return about

    def need_about(self) -> dict[str, Any]:
        """Return the same, or raise `InputError` where there is no study."""
        about = self.read_about()
        if about is None:
            raise InputError(f"study: there is no study in {str(self.folder)!r} (no study.json)")
        return about

    def write_about(self, about: Mapping[str, Any]) -> None:
        """Write `study.json`."""
        for part in ("runs", "trajectories") if about["trajectories"] else ("runs",):
            (self.folder / part).mkdir(parents=True, exist_ok=True)
        with replacing(self.folder / "study.json") as temporary:
            temporary.write_text(json.dumps({"format": FORMAT, **about}, indent=1), encoding="utf-8")

    def write(self, row: Row) -> None:
        """Write the row of a finished run."""
        pa, parquet = _arrow()
        with replacing(self.run_path(row["key"])) as temporary:
            parquet.write_table(pa.Table.from_pylist([row]), temporary, **PLAIN)

    def read(self, keys: Sequence[str]) -> dict[str, Row]:
        """Return the rows of finished runs by key; a file that cannot be read counts as not there."""
        pa, parquet = _arrow()
        found = {path.stem for path in (self.folder / "runs").glob("*.parquet")}
        rows: dict[str, Row] = {}
        for key in keys:
            if key not in found:
                continue
            try:
                content = self.run_path(key).read_bytes()
                (row,) = parquet.ParquetFile(pa.BufferReader(content)).read(use_threads=False).to_pylist()
                if row["key"] != key or not isinstance(row["error"], str):
                    raise ValueError("it is another run's")
            except (OSError, ValueError, KeyError) as error:  # pyarrow's errors are among them
                log.warning("study: runs/%s.parquet is damaged and will be run again: %s", key, error)
            else:
                rows[key] = row
        return rows

    def stale(self, keys: Container[str]) -> int:
        """Return the number of finished runs that are none of these."""
        return sum(path.stem not in keys for path in (self.folder / "runs").glob("*.parquet"))

    def write_table(self, table: pd.DataFrame) -> None:
        """Write the table of all runs."""
        pa, parquet = _arrow()
        with replacing(self.folder / "table.parquet") as temporary:
            parquet.write_table(pa.Table.from_pandas(table, preserve_index=False), temporary)


def status(folder: str | Path) -> Status:
    """Return how far the study in `folder` is, from its files alone.

    Raises
    ------
    InputError
        If there is no study.
    """
    store = Store(folder)
    about = store.need_about()
    return status_of(store, list(about["keys"]), bool(about["trajectories"]))


def status_of(store: Store, keys: Sequence[str], trajectories: bool) -> Status:
    """Return how far a study with these keys is."""
    rows = finished(store, keys, trajectories)
    ages = {path.stem: path.stat().st_mtime for path in (store.folder / "runs").glob("*.parquet")}
    last = sorted(ages[key] for key in rows if key in ages)[-100:]
    span = last[-1] - last[0] if len(last) > 1 else 0.0
    failed = sum(bool(row["error"]) for row in rows.values())
    rate = (len(last) - 1) / span if span > 0 else np.nan
    return Status(len(keys), len(rows), failed, len(keys) - len(rows), store.stale(keys), rate)


def finished(store: Store, keys: Sequence[str], trajectories: bool) -> dict[str, Row]:
    """Return the rows of runs that need not be done again, by key."""
    rows = store.read(keys)
    if trajectories:
        kept = {path.name for path in (store.folder / "trajectories").glob("*.zarr.zip")}
        rows = {key: row for key, row in rows.items() if row["error"] or store.trajectory_path(key).name in kept}
    return rows


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise MissingExtra("pyarrow", "study", "keeping a study in a folder") from None
    return pyarrow, pyarrow.parquet
