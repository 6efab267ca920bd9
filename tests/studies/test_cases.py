"""The published case in small, the demonstration, and the command line, as a user runs them."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from ctmhe.cli import app, main
from ctmhe.errors import InputError
from ctmhe.simulation import Run
from ctmhe.studies.reproduce import reproduce, study_reactor_budget, study_solves_saved
from ctmhe.studies.reproduce.reactor import CHANNELS, FAMILIES
from ctmhe.studies.reproduce.together import together, write
from fmus.build import build

CONFIG = """
[model]
inputs = []
outputs = ["pressure"]

[log]
time = "time"
outputs = { pressure = "p_total" }
units = { pressure = "bar" }

[estimator]
horizon = 2.0
interval = 0.1
integrator = { kind = "RK4", step = 0.05 }
cost = { eta = 0.4, P = [[8.0, 7.5], [7.5, 7.1]], Q = 2e3, R = 1e2 }
bounds = { x = { pA = [0.1, 5.0], pB = [0.1, 5.0] } }

[guess]
pA = 0.1
pB = 4.5

[trigger]
any = [{ name = "SendOnDelta", delta = 0.08 }, { name = "MaxInterval", seconds = 0.5 }]
"""

POLICY = """
from ctmhe import Trigger

class EveryTenth(Trigger):
    def next_time(self, ctx):
        return ctx.t + 0.1
"""


@pytest.fixture
def files(tmp_path):
    """A log, a configuration and the FMU."""
    from scipy.integrate import solve_ivp

    t = np.arange(0, 151) * 0.02
    rhs = lambda _, x: [-0.32 * x[0] ** 2 + 0.0128 * x[1], 0.16 * x[0] ** 2 - 0.0064 * x[1]]  # noqa: E731
    x = solve_ivp(rhs, (0, 3.0), [3.0, 1.0], t_eval=t, rtol=1e-9).y
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, len(t))
    pd.DataFrame({"time": t, "p_total": x.sum(axis=0) + noise}).to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "case.toml").write_text(CONFIG)
    (tmp_path / "policy.py").write_text(POLICY)
    return tmp_path, x


def arguments(folder, *more):
    """The command line of `estimate`."""
    fmu = build("batch_reactor", fmi=2)
    files = ["--fmu", fmu, "--log", folder / "log.csv", "--config", folder / "case.toml", "--out", folder / "out"]
    return ["estimate", *map(str, files), *more]


def test_a_log_and_an_fmu_become_estimates_on_disk(files):
    """`ctmhe estimate` writes the run, two tables and the plot; the hidden states are found."""
    folder, x = files
    result = CliRunner().invoke(app, arguments(folder))
    assert result.exit_code == 0, result.output
    run = Run.load(folder / "out" / "run.nc")
    assert 5 < run.samples < 60
    np.testing.assert_allclose(run.dataset["x_online"].values[-1], x[:, -1], atol=0.15)
    table = pd.read_csv(folder / "out" / "estimates.csv")
    assert len(table) == 151 and (folder / "out" / "estimates.png").stat().st_size > 10_000


def test_a_policy_of_ones_own_replaces_the_configurations(files):
    """--trigger file.py:Name."""
    folder, _ = files
    result = CliRunner().invoke(app, arguments(folder, "--trigger", f"{folder / 'policy.py'}:EveryTenth"))
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(Run.load(folder / "out" / "run.nc").gaps[1:], 0.1, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("horizon = 2.0", "horizn = 2.0", "unknown key 'horizn'; did you mean 'horizon'"),
        ("pA = 0.1\n", "pC = 0.1\n", "table [guess]: unknown key 'pC'"),
        ('pressure = "p_total"', 'pressure = "p"', "no column 'p'. Columns: time, p_total"),
        ('units = { pressure = "bar" }', 'units = { pressure = "Pa" }', "is in 'Pa' but the model has 'bar'"),
        ('units = { pressure = "bar" }', 'units = { pressure = "Pa" }', "multiply by 1e-5"),
        ('units = { pressure = "bar" }', 'units = { pressure = "degC" }', "these measure different things"),
        ('units = { pressure = "bar" }', 'units = { pressure = "psi" }', "'psi' is defined nowhere"),
        ('name = "SendOnDelta"', 'name = "SendOnDleta"', "did you mean 'SendOnDelta'"),
        ('name = "SendOnDelta"', 'name = "policy.py:EveryTenth"', "a configuration may not name a file"),
        ("[guess]", "[guess", "not valid TOML"),
        ("interval = 0.1", "interval = -0.1", "interval must be a positive"),
        ("eta = 0.4", "eta = 1.4", "eta must lie in"),
        ("eta = 0.4", "etta = 0.4", "etta"),
    ],
)
def test_mistakes_in_the_configuration_are_one_readable_paragraph(files, monkeypatch, capsys, old, new, message):
    """Exit code 1, the culprit named, no traceback."""
    folder, _ = files
    text = (folder / "case.toml").read_text()
    assert old in text
    (folder / "case.toml").write_text(text.replace(old, new, 1))
    monkeypatch.setattr("sys.argv", ["ctmhe", *arguments(folder)])
    with pytest.raises(SystemExit) as stop:
        main()
    error = " ".join(capsys.readouterr().err.split())
    assert stop.value.code == 1
    assert message in error and "Traceback" not in error


def test_fmu_info_tells_states_units_and_kinds():
    """`ctmhe fmu info` on the bundled quadrotor."""
    result = CliRunner().invoke(app, ["fmu", "info", str(build("quadrotor", fmi=3))])
    assert result.exit_code == 0
    for text in ("FMI 3.0", "model exchange  directional derivatives", "states (12)", "rad/s", "tunable"):
        assert text in result.output


def test_the_published_reactor_case_in_small(tmp_path):
    """rho and delta_bar as published; (3.32) holds, also at |w| <= 1e-3, where open loop breaks it."""
    file = tmp_path / "out.json"
    result = CliRunner().invoke(app, ["reproduce", "thesis-3.4.1-ct", "--seeds", "1", "--json", str(file)])
    assert result.exit_code == 0, result.output
    data = json.loads(file.read_text())
    assert set(data) >= {"published", "ours", "settings", "comment"}
    ours = data["ours"]["non_equidistant"]
    assert ours["rho"] == pytest.approx(data["published"]["rho"], abs=5e-4)  # printed with two digits: 0.860
    assert ours["delta_bar"] == pytest.approx(0.19)
    for kind in ("non_equidistant", "equidistant"):
        assert data["ours"][kind]["max_bound_ratio"] < 1
        assert data["ours"][kind]["max_bound_ratio_weak"] < 1 < data["ours"][kind]["max_bound_ratio_weak_open_loop"]
        assert set(data["ours"][kind]["error_norm_at"]) == {"0.1", "0.5", "1.0", "2.0"}


def test_the_reactor_budget_in_small(monkeypatch):
    """Thresholds are found for the budget, and every policy is compared with equal gaps on the same seeds."""
    monkeypatch.setattr(study_reactor_budget, "CHANNELS", {"single sample": CHANNELS["single sample"]})
    monkeypatch.setattr(study_reactor_budget, "FAMILIES", {"innovation": FAMILIES["innovation"]})
    result = reproduce("study-reactor-budget", seeds=2)
    ours = result["ours"]["single sample"]
    assert ours["failed_runs"] == 0
    assert ours["policies"]["innovation, hard budget"]["samples"]["mean"] <= 50
    assert ours["policies"]["dense first, linear gaps"]["samples"]["mean"] == 50
    assert ours["policies"]["equidistant, first at once"]["samples"]["mean"] == 50
    for base in ("equidistant", "equidistant, first at once"):
        for name, about in ours["policies"].items():
            difference = about["online_rms"]["mean"] - ours["policies"][base]["online_rms"]["mean"]
            if name != base:
                assert about[f"online_rms_against_{base}"]["difference"] == pytest.approx(difference)
                assert about[f"online_rms_against_{base}"]["pairs"] == 2
    assert "equidistant, first at once" in ours["better_than"]["equidistant"]["online_rms"]


def test_solves_saved_in_small(monkeypatch):
    """On the first seeds, too, an event saves 86 % of the solves within 5 % of the error; equal gaps do not."""
    monkeypatch.setattr(study_solves_saved, "THRESHOLDS", (0.11, 0.2))
    monkeypatch.setattr(study_solves_saved, "RIVALS", (0.1,))
    ours = reproduce("study-solves-saved", seeds=2)["ours"]
    assert ours["solves_saved_percent"] >= 86
    assert ours["rms_ratio"] <= 1.05
    assert len(ours["curve"]) == 5
    rivals = {point["policy"]: point for point in ours["same_number_of_solves"]}
    assert rivals["periodic"]["rms_ratio"] > 1.05


def test_an_unknown_case_lists_the_known_ones():
    """Names are told."""
    with pytest.raises(InputError, match=r"Known: thesis-3\.4\.1-ct"):
        reproduce("thesis-9")


def test_the_demonstration_prints_and_writes_what_it_says(tmp_path):
    """Samples, solves, errors beside periodic sampling with the same number of samples; plot and runs on disk."""
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "demo")])
    assert result.exit_code == 0, result.output
    event, periodic = Run.load(tmp_path / "demo" / "run.nc"), Run.load(tmp_path / "demo" / "periodic.nc")
    assert event.samples == periodic.samples
    assert f"{event.online_rms():.4f}" in result.output and f"{periodic.online_rms():.4f}" in result.output
    assert (tmp_path / "demo" / "estimates.png").stat().st_size > 10_000


def test_a_co_simulation_fmu_is_estimated_as_a_step_map(files):
    """The configuration names the step, and needs neither interval nor integrator; samples lie on the steps."""
    folder, x = files
    changes = {
        "[model]": '[model]\nkind = "CoSimulation"\nstep = 0.02',
        "interval = 0.1\n": "",
        'integrator = { kind = "RK4", step = 0.05 }\n': "",
        "R = 1e2": "R = 10",
        "Q = 2e3": "Q = 1e7",
        "eta = 0.4": "eta = 0.98",  # of a step
    }
    config = CONFIG
    for old, new in changes.items():
        config = config.replace(old, new)
    (folder / "case.toml").write_text(config)
    result = CliRunner().invoke(app, arguments(folder))
    assert result.exit_code == 0, result.output + repr(result.exception)
    run = Run.load(folder / "out" / "run.nc")
    np.testing.assert_allclose(run.dataset["x_online"].values[-1], x[:, -1], atol=0.15)


def test_cases_together_write_a_file_each_and_one_that_fails_stops_no_other(tmp_path):
    """Two good names and a bad one, two at a time: two files, equal to what each case gives alone, and one reason."""
    names = ("thesis-table-4.2", "thesis-9", "thesis-5.2.4-horizon")
    done = {one.name: one for one in together(names, jobs=2, folder=tmp_path)}
    assert set(done) == set(names)
    assert done["thesis-9"].result is None and "unknown case" in done["thesis-9"].error
    assert {path.stem for path in tmp_path.iterdir()} == {"thesis-table-4.2", "thesis-5.2.4-horizon"}
    kept = json.loads((tmp_path / "thesis-table-4.2.json").read_text())
    assert kept["ours"]["horizons"] == reproduce("thesis-table-4.2")["ours"]["horizons"]


def test_results_are_written_with_six_digits(tmp_path):
    """Round-off of another machine does not change a file; whole numbers, texts and NaN-free lists stay."""
    write({"ours": {"a": [1 / 3, 2], "b": "text", "c": (True, None)}, "x": 123456789.0}, tmp_path / "deep" / "r.json")
    kept = json.loads((tmp_path / "deep" / "r.json").read_text())
    assert kept == {"ours": {"a": [0.333333, 2], "b": "text", "c": [True, None]}, "x": 123457000.0}
