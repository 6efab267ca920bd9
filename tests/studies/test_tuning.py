"""Tuning: thresholds are bracketed, fronts are not dominated, searches repeat."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe import SendOnDelta, explore, find_threshold, pareto_front
from ctmhe.errors import InputError
from ctmhe.studies import status
from tests.studies.cases import Reactor


def count(*, seed, delta):
    """About 50 / delta^1.5 samples, with noise that is the same for all thresholds."""
    return {"samples": round(50 / delta**1.5 + np.random.default_rng(seed).normal()), "rms": delta, "size": 1 / delta}


@settings(deadline=None, max_examples=15)
@given(wanted=st.integers(10, 200), seed=st.integers(0, 100))
def test_a_threshold_meets_a_wanted_number_of_samples(wanted, seed):
    """Within the tolerance, or where the count jumps across the target; the answer is the best value tried."""
    found = find_threshold(count, "delta", (0.1, 10.0), target={"samples": wanted}, seeds=range(seed, seed + 3))
    assert found.reached == (abs(found.mean - wanted) <= 0.01 * wanted)
    assert found.reached or "jumps across the target" in found.message
    assert found.value == pytest.approx((50 / wanted) ** (1 / 1.5), rel=0.15)
    assert np.abs(found.history["mean"] - wanted).min() == abs(found.mean - wanted)
    assert found.low <= found.mean <= found.high and len(found.history) < 40


def test_a_jump_over_the_target_is_told():
    """A step function has no such value; the bracket closes in on the step."""
    step = find_threshold(
        lambda *, seed, x: {"n": 10.0 if x < 0.3 else 5.0}, "x", (-1.0, 1.0), target={"n": 7}, seeds=1, log=False
    )
    assert not step.reached and "n jumps across the target" in step.message
    assert step.value == pytest.approx(0.3, abs=2e-3)


def test_a_curve_that_rises_and_falls_is_told():
    """There may be other solutions."""
    found = find_threshold(
        lambda *, seed, x: {"n": (x - 2) * (x - 5) * (x - 8)}, "x", (1.0, 10.0), target={"n": 0.0}, seeds=1
    )
    assert min(abs(found.value - root) for root in (2, 5, 8)) < 0.01 and "not monotone" in found.message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bracket": (5.0, 10.0)}, r"does not enclose samples = 50: it is 5 at delta = 5 and 2 at delta = 10"),
        ({"bracket": (0.0, 1.0)}, "0 < low < high"),
        ({"bracket": 3}, r"delta: expected a range"),
        ({"target": {"samples": 1, "rms": 2}}, "one metric and its value"),
        ({"target": {"sample": 50}}, "did you mean 'samples'"),
        ({"case": lambda *, seed, delta: {}["x"]}, "every run at delta = 0.1 failed, the first with KeyError"),
    ],
)
def test_a_search_that_cannot_succeed_is_told(options, message):
    """Both ends of the bracket are given."""
    options = {"case": count, "bracket": (0.1, 10.0), "target": {"samples": 50}, "seeds": [0]} | options
    with pytest.raises(InputError, match=message):
        find_threshold(options.pop("case"), "delta", **options)


def test_the_reactor_is_given_a_budget_of_samples_and_a_stopped_search_goes_on(tmp_path):
    """Send-on-delta with six samples on average; the second search finds all runs in the folder."""
    reactor = Reactor()

    def case(*, seed, delta):
        return reactor(seed=seed, policy=SendOnDelta(delta))

    options = {"target": {"samples": 6}, "seeds": 2, "tolerance": 0.1, "folder": tmp_path}
    found = find_threshold(case, "delta", (0.02, 1.0), **options)
    assert found.reached and abs(found.mean - 6) <= 0.6
    again = find_threshold(case, "delta", (0.02, 1.0), **options)
    pd.testing.assert_frame_equal(found.history, again.history)
    assert all(status(folder).done == 2 for folder in tmp_path.iterdir())


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=20))
def test_a_front_is_what_nothing_dominates_and_everything_else_is_dominated(points):
    """By definition; sorted by the first column; NaN is left out."""
    table = pd.DataFrame([*points, (np.nan, -1)], columns=["a", "b"])
    front = pareto_front(table, ["a"], maximise=["b"])
    inside = set(front.index)

    def beats(p, q):
        return p[0] <= q[0] and p[1] >= q[1] and p != q

    for i, point in enumerate(points):
        assert (i in inside) == (not any(beats(other, point) for other in points))
    assert front["a"].is_monotonic_increasing and len(points) not in inside
    with pytest.raises(InputError, match=r"no column 'c'\. Columns: a, b"):
        pareto_front(table, ["c"])


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
def test_a_search_repeats_and_ends_with_a_front(tmp_path, sampler):
    """The same seed tries the same points; with a folder nothing is run twice; another seed tries others."""
    pytest.importorskip("optuna")
    space = {"delta": (0.1, 10.0), "kind": {"slow": 1.0, "fast": 2.0}, "n": [1, 2]}

    def case(*, seed, delta, kind, n):
        return {**count(seed=seed, delta=delta), "cost": kind * n}

    options = {"trials": 12, "batch": 4, "seeds": 2, "log": ["delta"], "sampler": sampler}
    aims = {"samples": "minimise", "size": "maximise", "cost": "minimise"}
    found = explore(case, space, aims, folder=tmp_path, **options)
    pd.testing.assert_frame_equal(explore(case, space, aims, folder=tmp_path, **options).runs, found.runs)
    pd.testing.assert_frame_equal(explore(case, space, aims, **options).table, found.table)
    assert list(found.table.columns) == ["delta", "kind", "n", "samples", "size", "cost"]
    assert len(found.runs) == 2 * len(found.table) and set(found.front.index) <= set(found.table.index)
    assert explore(case, space, aims, seed=1, **options).table["delta"][0] != found.table["delta"][0]


def test_points_of_choices_are_tried_once_and_points_that_fail_are_left_out():
    """A space of two points needs two points' runs; a metric without a value is no part of the front."""
    pytest.importorskip("optuna")
    ran = []

    def case(*, seed, kind):
        if kind == "bad":
            raise ValueError("as told")
        ran.append(kind)
        return {"cost": 1.0}

    found = explore(case, {"kind": ["bad", "good"]}, "cost", trials=12, batch=6, seeds=1)
    assert ran == ["good"] and found.front["kind"].tolist() == ["good"] and len(found.table) == 2
    with pytest.raises(InputError, match="every run of a batch failed, the first with ValueError"):
        explore(case, {"kind": ["bad"]}, "cost", trials=2, seeds=1)
    for options, message in [({"sampler": "random"}, "sampler"), ({"trials": 0}, "at least 1")]:
        with pytest.raises(InputError, match=message):
            explore(case, {"kind": ["good"]}, "cost", **options)
    with pytest.raises(InputError, match="expected 'minimise' or 'maximise'"):
        explore(case, {"kind": ["good"]}, {"cost": "min"})
