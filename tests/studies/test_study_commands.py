"""`ctmhe study`: the example of the page, stopping and going on, and what the screens say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner

from ctmhe.cli import app, main
from ctmhe.studies import StudyResult

PAGE = Path(__file__).parents[2] / "docs" / "cli.md"
EXAMPLE = re.compile(r"^```toml study *\n(.*?)^```", re.MULTILINE | re.DOTALL)
STUDY = """
[study]
seeds = 3
[grid]
gain = [1.0, 2.0]
mode = ["good", "bad"]
"""
CASE = """
from pathlib import Path

def doubled(x):
    return 2 * x

def case(*, seed, gain, mode):
    if mode == "bad" and seed == 1 and not Path(__file__).with_name("mended").exists():
        raise ValueError(f"gain {gain:g} is too large")
    return {"cost": doubled(gain) + seed}

def stopped(*, seed, gain, mode):
    if seed == 2 and not Path(__file__).with_name("mended").exists():
        raise KeyboardInterrupt
    return case(seed=seed, gain=gain, mode="good")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a study and cases, as the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CTMHE_COMPILE", "off")
    (tmp_path / "grid.toml").write_text(STUDY)
    (tmp_path / "cases.py").write_text(CASE)
    return tmp_path


def ctmhe(*arguments, code=0):
    """Run a command, check its exit code, and return what it printed."""
    result = CliRunner().invoke(app, ["study", *map(str, arguments)])
    assert result.exit_code == code, result.output + repr(result.exception)
    return result.output


def test_the_example_of_the_page_runs_and_is_reported(folder):
    """Run, status and report of the complete study in docs/cli.md; its numbers are on the screen."""
    (text,) = EXAMPLE.findall(PAGE.read_text("utf-8"))
    (folder / "study.toml").write_text(text)
    said = ctmhe("run", "study.toml")
    result = StudyResult.load("results/reactor")
    assert len(result.table) == 12 and not len(result.failed)
    assert f"{result.summary('online_rms')['mean'].iloc[0]:.4g}" in said
    assert "4 points, 3 seeds, 12 runs" in said and "ctmhe study report results/reactor" in said
    assert "12 of 12 runs done" in ctmhe("status", "results/reactor")
    assert "report.html" in ctmhe("report", "results/reactor", "--baseline", "trigger=even")
    page = (folder / "results" / "reactor" / "report.html").read_text("utf-8")
    assert page.count("<figure>") == 6  # error, front, differences, gaps, solve times, a run
    assert "roots found by CVODE" in page or "search with rollback" in page
    assert "Compared with trigger = even" in page and "v_pressure" in page


def test_a_case_of_ones_own_is_run_on_workers(folder):
    """--case: the file is named on the command line, and its functions go with it."""
    here = ctmhe("run", "grid.toml", "--case", "cases.py:case", "--out", "one", code=1)
    assert "2 of 12 runs failed" in here and "gain = 1.0, mode = bad, seed = 1: ValueError: gain 1 is too large" in here
    ctmhe("run", "grid.toml", "--case", "cases.py:case", "--out", "two", "--workers", "2", code=1)
    one, two = (StudyResult.load(name).table.drop(columns="seconds") for name in ("one", "two"))
    pd.testing.assert_frame_equal(one, two)


def test_ctrl_c_leaves_a_folder_that_goes_on(folder, monkeypatch):
    """It says how; what was done is not done again; the result is that of a study that was never stopped."""
    said = ctmhe("run", "grid.toml", "--case", "cases.py:stopped", "--out", "s", code=130)
    assert "8 of 12 runs done" in said and "ctmhe study resume s" in said
    assert "4 missing" in ctmhe("status", "s")
    (folder / "mended").touch()
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)  # the folder remembers where the case is
    said = ctmhe("resume", "../s")
    assert "8 runs are there already" in said and "4 runs in" in said and "Study 'grid'" in said
    assert StudyResult.load(folder / "s").table["cost"].tolist() == [2.0, 3.0, 4.0] * 2 + [4.0, 5.0, 6.0] * 2


def test_failed_runs_are_done_again_when_asked_to(folder):
    """Their error is in exit code and status until then."""
    ctmhe("run", "grid.toml", "--case", "cases.py:case", "--out", "s", code=1)
    assert "2 of 12 runs failed" in ctmhe("status", "s", code=1)
    (folder / "mended").touch()
    ctmhe("resume", "s", code=1)
    assert "2 runs in" in ctmhe("resume", "s", "--retry-failed")
    assert "failed" not in ctmhe("status", "s")


def test_more_seeds_add_runs(folder):
    """And `resume` knows how many there are."""
    (folder / "mended").touch()
    ctmhe("run", "grid.toml", "--case", "cases.py:case", "--out", "s")
    said = ctmhe("run", "grid.toml", "--case", "cases.py:case", "--out", "s", "--seeds", "4")
    assert "12 runs are there already" in said and "4 runs in" in said
    assert "16 runs are there already" in ctmhe("resume", "s")
    assert json.loads((folder / "s" / "order.json").read_text())["seeds"] == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "nowhere.toml"], "no configuration file 'nowhere.toml'"),
        (["run", "grid.toml"], "table [study] needs until"),
        (["run", "grid.toml", "--case", "cases.py:cas"], "no function 'cas' in it. There: doubled, case, stopped"),
        (["run", "grid.toml", "--case", "cases.py"], "expected file.py:Name"),
        (["run", "grid.toml", "--case", "no.py:case"], "no file 'no.py'"),
        (["run", "grid.toml", "--case", "cases.py:doubled"], "does not take (seed, gain, mode)"),
        (["status", "nowhere"], "there is no study in 'nowhere'"),
        (["resume", "nowhere"], "'nowhere' holds no study"),
        (["report", "nowhere"], "there is no study in 'nowhere'"),
    ],
)
def test_mistakes_are_one_readable_paragraph(folder, monkeypatch, capsys, arguments, message):
    """Exit code 1, no traceback, nothing begun."""
    if arguments[:2] == ["run", "grid.toml"] and len(arguments) == 2:
        (folder / "grid.toml").write_text("[study]\n[plant]\nmodel = 'chua'\n[trigger]\nname = 'Periodic'\n")
    monkeypatch.setattr("sys.argv", ["ctmhe", "study", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    error = " ".join(capsys.readouterr().err.split())
    assert stop.value.code == 1
    assert message in error and "Traceback" not in error
    assert not (folder / "results").exists()
