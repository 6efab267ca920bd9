"""Figures of a run, by what is drawn: never by what they look like."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from ctmhe import MHE, RK4, DiscountedCost, MaxInterval, SendOnDelta, SingleSample, simulate
from ctmhe.errors import InputError
from ctmhe.models.library import batch_reactor
from ctmhe.plotting import plot_gap_histogram, plot_level, plot_run, plot_solve_times

matplotlib.use("agg")


@pytest.fixture(scope="module")
def run():
    """A short run of the reactor."""
    model = batch_reactor(noise=False)
    cost = DiscountedCost(P=0.1, Q=1e3, R_point=1e4)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(step=0.1), cost=cost, hold="point", compile="off")
    policy = SendOnDelta(0.1) | MaxInterval(0.3)
    return simulate(
        model,
        mhe,
        trigger=policy,
        until=1.0,
        truth=[3.0, 1.0],
        guess=[3.0, 1.0],
        channel=SingleSample(),
        monitor=0.05,
        seed=0,
    )


@pytest.fixture(autouse=True)
def closed():
    """Figures are closed after a test."""
    yield
    from matplotlib import pyplot

    pyplot.close("all")


def with_level(run, values):
    """Return the run's dataset with a level on its monitoring times."""
    return run.dataset.assign(level=("time", np.resize(np.asarray(values, dtype=float), len(run.t))))


def test_a_level_gets_a_panel_of_its_own_between_outputs_and_gaps(run):
    """Two states, an output, the level, the gaps."""
    axes = plot_run(with_level(run, [-0.1, -0.05, -0.01]))
    assert [panel.get_ylabel().split(" ")[0] for panel in axes] == ["pA", "pB", "pressure", "level", "gap"]


@pytest.mark.parametrize("level", [np.nan, np.inf, -np.inf])
def test_a_policy_without_a_finite_level_gets_none(run, level):
    """NaN is no level, and infinite ones alone have no scale."""
    assert len(plot_run(with_level(run, [level]))) == 4


def test_infinite_levels_are_drawn_at_the_edge(run):
    """A certain yes and a certain no stay inside the panel, and zero is always in sight."""
    from matplotlib import pyplot

    axes = plot_level(with_level(run, [np.inf, -0.2, -0.1, -np.inf, np.nan]), pyplot.figure().add_subplot())
    low, high = axes.get_ylim()
    drawn = axes.lines[0].get_ydata()
    assert low < -0.2 and high > 0.0
    assert np.nanmin(drawn) > low and np.nanmax(drawn) < high


def test_too_few_axes_are_told_what_is_missing(run):
    """The message counts."""
    from matplotlib import pyplot

    with pytest.raises(InputError, match="5 axes are needed for 2 states, 1 outputs, level, gaps; got 1"):
        plot_run(with_level(run, [-1.0]), pyplot.figure().add_subplot())


def test_a_histogram_of_gaps_shares_out_all_of_them(run):
    """The shares of a family sum to one, and the wait before the first sample is not counted."""
    axes = plot_gap_histogram({"one": run, "two": [run, run]})
    for steps in axes.patches:
        assert np.isclose(np.sum(steps.get_data().values), 1.0)
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert texts[0].startswith(f"one: {run.samples - 1} gaps") and texts[1].startswith(
        f"two: {2 * run.samples - 2} gaps"
    )


def test_gaps_over_decades_are_drawn_on_a_logarithmic_axis():
    """Equal ratios, once they spread enough."""
    assert plot_gap_histogram([0.01, 0.1, 2.0]).get_xscale() == "log"
    assert plot_gap_histogram([0.1, 0.2]).get_xscale() == "linear"


def test_solve_times_reach_one_at_the_longest(run):
    """An empirical distribution, in milliseconds."""
    axes = plot_solve_times([1e-3, 4e-3, 2e-3, 3e-3])
    x, y = axes.lines[0].get_data()
    np.testing.assert_allclose(x, [1, 2, 3, 4])
    np.testing.assert_allclose(y, [0.25, 0.5, 0.75, 1.0])
    assert "median 2 ms, 99 % within 4 ms" in axes.get_legend().get_texts()[0].get_text()
    assert plot_solve_times({"reactor": run}).get_xscale() == "log"


def test_nothing_to_draw_is_an_error_that_says_so():
    """Families without values do not make an empty figure."""
    with pytest.raises(InputError, match="no gaps to draw in even"):
        plot_gap_histogram({"even": []})
