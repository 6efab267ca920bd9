"""Runs as results: errors, tables, files, figures; and replays of what was recorded."""

import sys

import numpy as np
import pytest

from ctmhe.data import MeasurementLog
from ctmhe.errors import InputError, MissingExtra
from ctmhe.estimators import MHE
from ctmhe.models.continuous import ContinuousModel
from ctmhe.simulation import Run, SingleSample, Uniform, replay, simulate
from ctmhe.transcription.integrators import RK4
from ctmhe.triggers import MaxInterval, MinInterval, Periodic, SendOnDelta
from ctmhe.types import DiscountedCost

MODEL = ContinuousModel(
    lambda t, x, u, w, p: [x[1], -2 * x[0] - 0.3 * x[1] + u[0] + w[0]],
    lambda t, x, u, w, p: x[0] + w[1],
    x=("position", "speed"),
    y="sensor",
    u="force",
    w=("d", "v"),
    units={"position": "m", "speed": "m/s", "sensor": "m", "force": "N"},
    name="spring",
)
COST = DiscountedCost(eta=0.7, P=1.0, Q=[1.0, 100.0], R=50.0)
SETTINGS = {"horizon": 1.0, "interval": 0.1, "integrator": RK4(step=0.05), "cost": COST}
POLICY = (SendOnDelta(0.1) | MaxInterval(0.4)) & MinInterval(0.02)


@pytest.fixture(scope="module")
def mhe():
    return MHE(MODEL, **SETTINGS, hold="point")


@pytest.fixture(scope="module")
def result(mhe):
    return simulate(
        MODEL,
        mhe,
        trigger=POLICY,
        until=3.0,
        guess=[0.0, 0.0],
        truth={"position": 1.0, "speed": 0.5},
        channel=SingleSample(),
        disturbance={"v": Uniform(0.01), "d": Uniform(0.1, interval=0.1)},
        inputs=lambda t: [np.sin(t)],
        monitor=0.05,
        seed=11,
    )


def test_a_run_saves_and_loads_unchanged(result, tmp_path):
    """NetCDF and back: values, names, units, attributes; nothing else is left in the folder."""
    path = result.save(tmp_path / "deep" / "run.nc")
    loaded = Run.load(path)
    assert loaded.dataset.identical(result.dataset)
    assert repr(loaded) == repr(result)
    assert [entry.name for entry in path.parent.iterdir()] == ["run.nc"]


def test_a_run_without_samples_saves_and_loads_unchanged(mhe, tmp_path):
    """Empty event tables survive the round trip too."""
    empty = simulate(MODEL, mhe, trigger=SendOnDelta(np.inf), until=0.2, guess=[0, 0], truth=[1, 0], inputs=[0.0],
                     channel=SingleSample())  # fmt: skip
    loaded = Run.load(empty.save(tmp_path / "run.nc"))
    assert loaded.dataset.identical(empty.dataset)
    assert (loaded.samples, loaded.outcomes, loaded.solves) == (0, {}, 0)
    assert "samples: 0" in repr(loaded)


def test_loading_what_is_no_run_is_an_error(result, tmp_path):
    """Missing, damaged and foreign files are told apart from runs."""
    with pytest.raises(InputError, match="no file"):
        Run.load(tmp_path / "nothing.nc")
    (tmp_path / "text.nc").write_text("not NetCDF")
    with pytest.raises(InputError, match="cannot be read"):
        Run.load(tmp_path / "text.nc")
    result.dataset.assign_attrs(format="other").to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="'other'"):
        Run.load(tmp_path / "other.nc")


def test_errors_are_what_their_names_say(result):
    """RMS and integrated squared error against their formulas."""
    data = result.dataset
    online = data["x_online"].to_numpy() - data["x_true"].to_numpy()
    retro = data["x_retro"].to_numpy() - data["x_true"].to_numpy()
    assert result.online_rms() == pytest.approx(np.sqrt(np.mean(np.sum(online**2, axis=1))))
    assert result.online_rms("speed") == pytest.approx(np.sqrt(np.mean(online[:, 1] ** 2)))
    assert result.retrospective_rms("position") == pytest.approx(np.sqrt(np.mean(retro[:, 0] ** 2)))
    squares = np.sum(retro**2, axis=1)
    assert result.ise == pytest.approx(np.sum(np.diff(result.t) * (squares[1:] + squares[:-1]) / 2))
    with pytest.raises(InputError, match="unknown state 'velocity'"):
        result.online_rms("velocity")
    late = result.t >= 0.5
    assert result.online_rms(since=0.5) == pytest.approx(np.sqrt(np.mean(np.sum(online[late] ** 2, axis=1))))
    assert result.online_rms(("position", "speed")) == result.online_rms()
    assert result.retrospective_rms("speed", since=0.5) == pytest.approx(np.sqrt(np.mean(retro[late, 1] ** 2)))
    with pytest.raises(InputError, match="no monitoring time at or after since = 99"):
        result.online_rms(since=99)
    with pytest.raises(InputError, match="unknown state"):
        result.online_rms([])


def test_axes_carry_names_and_units(result):
    """Every value can be found by name, and says its unit."""
    assert result.dataset["x_online"].sel(state="speed")["state_unit"].item() == "m/s"
    assert result.dataset["time"].attrs["units"] == "s"
    assert result.dataset["w"].dims == ("time", "disturbance")


def test_tables_hold_the_same_values(result):
    """The pandas views are the dataset, column by column."""
    table, events, solves = result.to_pandas(), result.events_to_pandas(), result.solves_to_pandas()
    np.testing.assert_array_equal(table["x_retro.speed"], result.dataset["x_retro"].sel(state="speed"))
    np.testing.assert_array_equal(events["sample_time"], result.sample_times)
    np.testing.assert_array_equal(solves["x_hat.position"], result.dataset["x_hat"].sel(state="position"))
    assert len(events) == result.samples
    assert len(solves) == result.solves == sum(result.outcomes.values())


def test_a_run_draws_itself(result):
    """One panel for each state and output and the gaps; nothing is shown, given Axes are used."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    axes = result.plot()
    assert [panel.get_ylabel() for panel in axes] == ["position [m]", "speed [m/s]", "sensor [m]", "level", "gap [s]"]
    _, grid = pyplot.subplots(5, 1)
    assert list(result.plot(grid)) == list(grid.reshape(-1))
    with pytest.raises(InputError, match="5 axes are needed"):
        result.plot(grid[:3])
    pyplot.close("all")


def test_drawing_without_matplotlib_names_the_extra(result, monkeypatch):
    """The library is imported late, and its absence says what to install."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtra, match=r"ctmhe\[plot\]"):
        result.plot()


def log_of(result):
    """Merge the records at monitoring times and at events into a log."""
    data = result.dataset
    t = np.concatenate([result.t, result.sample_times])
    y = np.concatenate([data["y"].to_numpy(), data["y_sampled"].to_numpy()])
    t, first = np.unique(t, return_index=True)
    u = np.sin(np.floor(t / 0.05 + 1e-9) * 0.05)[:, None]
    return MeasurementLog(t, y[first], ("sensor",), u, ("force",))


def test_replay_of_a_recorded_run_reproduces_its_events_and_estimates(result, mhe):
    """The log of a run, through the same trigger, gives the same samples and the same estimates."""
    again = replay(log_of(result), mhe, trigger=POLICY, guess=[0.0, 0.0])
    np.testing.assert_allclose(again.sample_times, result.sample_times, atol=1e-12)
    np.testing.assert_allclose(again.dataset["x_hat"], result.dataset["x_hat"], atol=1e-7)
    assert again.measurements == result.measurements


def test_replay_is_causal(result, mhe):
    """Cutting the log short, or changing its future, changes nothing before."""
    log = log_of(result)
    full = replay(log, mhe, trigger=POLICY, guess=[0.0, 0.0])
    cut = replay(log, mhe, trigger=POLICY, guess=[0.0, 0.0], until=1.5)
    future = log.t > 1.5
    y = np.where(future[:, None], 7.0, log.y)
    other = replay(MeasurementLog(log.t, y, log.outputs, log.u, log.inputs), mhe, trigger=POLICY, guess=[0, 0])
    rows = cut.t <= 1.5
    for run in (cut, other):
        np.testing.assert_array_equal(run.dataset["x_online"][: rows.sum()], full.dataset["x_online"][: rows.sum()])
        np.testing.assert_array_equal(
            run.sample_times[run.sample_times <= 1.5], full.sample_times[full.sample_times <= 1.5]
        )


def test_replay_delivers_the_records_and_nothing_made_up():
    """Whole signal: every row once, by the next event; a self-triggered event between rows adds no value."""
    t = np.arange(21) * 0.1
    log = MeasurementLog(t, np.cos(t)[:, None], ("sensor",), np.zeros((21, 1)), ("force",))
    result = replay(log, MHE(MODEL, **SETTINGS), trigger=Periodic(0.25), guess=[1.0, 0.0])
    np.testing.assert_allclose(result.sample_times, 0.25 * np.arange(9), atol=1e-12)
    assert result.measurements == 21
    with pytest.raises(InputError, match="true value of position, speed is not known"):
        result.online_rms()
    assert "rms" not in repr(result)


def test_silent_sensors_in_a_log_are_missing(mhe):
    """NaN rows trigger nothing and are not measurements to the estimator."""
    t = np.arange(11) * 0.1
    y = np.where(np.arange(11) % 2, np.nan, 1.0)[:, None]
    log = MeasurementLog(t, y, ("sensor",), np.zeros((11, 1)), ("force",))
    result = replay(log, mhe, trigger=SendOnDelta(0.0), guess=[1.0, 0.0])
    np.testing.assert_allclose(result.sample_times, t[::2])


def test_a_log_in_another_unit_than_the_models_is_refused(result, mhe):
    """Where the log states units they are compared, for models of any kind; what is not stated is not."""
    log = log_of(result)

    def stating(**units):
        given = MeasurementLog(log.t, log.y, log.outputs, log.u, log.inputs, units)
        return replay(given, mhe, trigger=POLICY, guess=[0.0, 0.0])

    np.testing.assert_array_equal(stating(sensor="m").sample_times, result.sample_times)
    with pytest.raises(InputError, match="'force' is in 'kW' but the model has 'N'"):
        stating(sensor="m", force="kW")


def test_a_log_that_does_not_fit_is_refused(mhe):
    """Missing inputs, foreign outputs and empty spans."""
    t, y, u = np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 1))
    with pytest.raises(InputError, match="input force"):
        replay(MeasurementLog(t, y, ("sensor",), np.empty((3, 0))), mhe, trigger=POLICY, guess=[0, 0])
    with pytest.raises(InputError, match="outputs gauge"):
        replay(MeasurementLog(t, y, ("gauge",), u, ("force",)), mhe, trigger=POLICY, guess=[0, 0])
    with pytest.raises(InputError, match="rows between"):
        replay(MeasurementLog(t, y, ("sensor",), u, ("force",)), mhe, trigger=POLICY, guess=[0, 0], start=5.0)
