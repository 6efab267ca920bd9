"""Folders of studies: nothing is done twice, nothing stale is used, nothing half is believed."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from ctmhe import Periodic, SendOnDelta, Study, StudyResult
from ctmhe.errors import InputError
from ctmhe.studies import status
from tests.studies.cases import Reactor, draw, troubled
from tests.studies.test_study import numbers, same

KILLED = """
import time
from ctmhe import Study
from tests.studies.cases import draw

def case(*, seed, gain):
    time.sleep(0.003)
    return draw(seed=seed, gain=gain)

if __name__ == "__main__":
    import sys
    Study(case, {"gain": range(1, 11)}, seeds=10, folder=sys.argv[1]).run()
"""


@dataclass(frozen=True)
class Line:
    """A case that is an object."""

    factor: float = 1.0

    def __call__(self, *, seed, gain):
        return {"value": self.factor * gain + seed}


def runs_of(study):
    """Run a study; return how many runs that took."""

    def written():
        return {(path.name, path.stat().st_mtime_ns) for path in (study.store.folder / "runs").glob("*")}

    before = written()
    study.run()
    return len(written() - before)


def test_a_finished_run_is_not_done_again_and_an_extended_study_does_what_is_new(tmp_path):
    """More seeds, more points: only those are run, and the table is that of a study done at once."""
    grid, more = {"gain": [1.0, 2.0]}, {"gain": [3.0, 2.0, 1.0]}
    assert runs_of(Study(Line(), grid, 2, folder=tmp_path)) == 4
    assert runs_of(Study(Line(), grid, 2, folder=tmp_path)) == 0
    assert runs_of(Study(Line(), grid, 3, folder=tmp_path)) == 2
    assert runs_of(Study(Line(), more, 3, folder=tmp_path)) == 3
    same(Study(Line(), more, 3, folder=tmp_path).result(), Study(Line(), more, 3).run())
    same(StudyResult.load(tmp_path), Study(Line(), more, 3).run())
    whole = tmp_path / "whole"
    assert runs_of(Study(Line(), {"gain": [1, 2, 3]}, 3, folder=whole)) == 9
    assert runs_of(Study(Line(), {"gain": [0.5, 1, 2, 3]}, 3, folder=whole)) == 3  # 1 is called 1.0 now
    stored = pd.read_parquet(tmp_path / "table.parquet")
    pd.testing.assert_frame_equal(stored, Study(Line(), more, 3, folder=tmp_path).result().table)


def test_a_changed_case_is_run_again_and_the_old_runs_are_called_stale(tmp_path, caplog):
    """Nothing old is used without a word; `version=` does the same by hand; going back finds the old runs."""
    grid = {"gain": [1.0, 2.0]}
    Study(Line(), grid, 2, folder=tmp_path).run()
    changed = Study(Line(factor=2.0), grid, 2, folder=tmp_path)
    assert changed.status().missing == 4 and changed.status().stale == 4
    assert runs_of(changed) == 4 and "4 kept runs are stale" in caplog.text
    assert runs_of(Study(Line(), grid, 2, folder=tmp_path, version="b")) == 4
    assert runs_of(Study(Line(), grid, 2, folder=tmp_path)) == 0
    assert changed.result().table["value"].tolist() == [2.0, 3.0, 4.0, 5.0]


def test_a_folder_of_another_study_is_refused(tmp_path):
    """What differs is named."""
    Study(Line(), {"gain": [1.0, 2.0]}, 2, folder=tmp_path).run()
    for other, message in [
        (lambda: Study(draw, {"gain": [1.0, 2.0]}, 2, folder=tmp_path), r"runs of .*Line, not of .*draw"),
        (lambda: Study(Line(), {"gain": [1.0, 3.0]}, 2, folder=tmp_path), r"gain=2\.0, which this design lacks"),
        (lambda: Study(Line(), {"gain": [1.0, 2.0]}, [0, 5], folder=tmp_path), "a study with seed 1"),
    ]:
        with pytest.raises(InputError, match=message):
            other()
    (tmp_path / "study.json").write_text("{}")
    with pytest.raises(InputError, match="not the file of a study"):
        status(tmp_path)
    with pytest.raises(InputError, match="there is no study"):
        status(tmp_path / "nowhere")


@pytest.mark.parametrize("damage", [b"", b"PAR1", None])
def test_a_damaged_file_is_ignored_and_its_run_done_again(tmp_path, caplog, damage):
    """Empty, cut off, or another run's; a warning tells."""
    study = Study(draw, {"gain": [1.0, 2.0]}, 2, folder=tmp_path)
    whole = study.run()
    first, second, *_ = sorted((tmp_path / "runs").iterdir())
    first.write_bytes(second.read_bytes() if damage is None else damage)
    assert study.status().missing == 1
    same(study.run(), whole)
    assert "is damaged" in caplog.text and study.status().missing == 0


def test_failed_runs_are_kept_and_retried_when_asked(tmp_path):
    """A row with an error is a finished run."""
    study = Study(troubled, {"kind": ["fine", "raises"]}, 2, folder=tmp_path)
    study.run()
    seconds = study.result().table["seconds"]
    assert study.run().table["seconds"].equals(seconds)
    again = study.run(retry_failed=True).table["seconds"]
    assert (again != seconds).tolist() == [False, False, False, True]


def test_status_is_read_from_the_files_alone(tmp_path):
    """Total, done, failed, missing, rate."""
    Study(troubled, {"kind": ["fine", "raises"]}, 3, folder=tmp_path).run()
    now = status(tmp_path)
    assert (now.total, now.done, now.failed, now.missing, now.stale) == (6, 6, 1, 0, 0)
    assert now.rate > 0 and now.seconds_left == 0 and repr(now) == "6 of 6 runs done, 0 missing, 1 failed"
    next((tmp_path / "runs").iterdir()).unlink()
    assert status(tmp_path).missing == 1


def test_a_study_killed_at_any_moment_goes_on_and_ends_as_if_never_stopped(tmp_path):
    """Five times SIGKILL; the table is that of an uninterrupted study, bit for bit but for the timings."""
    script, folder = tmp_path / "killed.py", tmp_path / "study"
    script.write_text(KILLED)
    lots = random.Random(0)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, str(script), str(folder)]
    done = 0
    for _ in range(5):
        process = subprocess.Popen(command, env=environment)
        wanted = done + lots.randint(1, 12)
        while len(list((folder / "runs").glob("*.parquet"))) < wanted and process.poll() is None:
            time.sleep(lots.uniform(0, 0.01))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert done < status(folder).done < 100
        done = status(folder).done
    subprocess.run(command, env=environment, check=True)
    stored = pd.read_parquet(folder / "table.parquet").drop(columns=["seconds", "key"])
    at_once = numbers(Study(draw, {"gain": range(1, 11)}, 10).run()).drop(columns="key")
    pd.testing.assert_frame_equal(stored, at_once, check_exact=True)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_kept_trajectory_is_the_run_itself(tmp_path, workers):
    """Every variable, name, unit and attribute; and any reader of Zarr opens it."""
    from zarr.storage import ZipStore

    study = Study(Reactor(), {"policy": [SendOnDelta(0.1), Periodic(0.3)]}, 1, folder=tmp_path, trajectories=True)
    result = study.run(workers)
    run, again = result.run(1), study.repeat(1)
    xr.testing.assert_identical(run.dataset.drop_vars("solve_seconds"), again.dataset.drop_vars("solve_seconds"))
    assert repr(run).splitlines()[:-2] == repr(again).splitlines()[:-2]
    with ZipStore(next((tmp_path / "trajectories").iterdir()), mode="r") as store:
        assert xr.open_zarr(store, consolidated=False)["x_true"].dims == ("time", "state")
    for path in (tmp_path / "trajectories").iterdir():
        path.unlink()
    assert study.status().missing == 2  # a run whose trajectory is gone is not finished
    with pytest.raises(InputError, match="there is no trajectory"):
        result.run(0)


def test_a_trajectory_that_was_wanted_and_is_none_is_an_error(tmp_path):
    """Of the run; a damaged one is told when it is read."""
    result = Study(draw, {"gain": [1.0]}, 1, folder=tmp_path / "a", trajectories=True).run()
    assert "the case returned no Run" in result.table["error"][0]
    with pytest.raises(InputError, match="this run failed"):
        result.run(0)
    result = Study(Reactor(), {"policy": [Periodic(0.5)]}, 1, folder=tmp_path / "b", trajectories=True).run()
    next((tmp_path / "b" / "trajectories").iterdir()).write_bytes(b"PK")
    with pytest.raises(InputError, match="cannot be read as Zarr"):
        result.run(0)


def test_rows_survive_their_file_bit_for_bit(tmp_path):
    """Numbers at the ends of their ranges, NaN, infinity, text of any kind."""
    hard = {
        "tiny": 5e-324,
        "third": 1 / 3,
        "nan": float("nan"),
        "inf": float("inf"),
        "whole": 2**62,
        "huge": 2**70,
        "yes": np.bool_(True),
        "text": "µ, \n, ''",
    }

    def case(*, seed):
        return hard

    kept = Study(case, seeds=1, folder=tmp_path)
    same(kept.run(), Study(case, seeds=1).run())
    same(kept.result(), Study(case, seeds=1).run())
