"""Results: means, intervals, differences by pairs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ctmhe import Periodic, Study
from ctmhe.errors import InputError
from ctmhe.statistics import interval
from ctmhe.studies.results import make_table
from tests.studies.cases import Reactor, draw

VALUES = st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=12)


def result_of(values):
    """A result from {(policy, load): one value a seed}; None for a failed run."""
    rows = [
        {"policy": policy, "load": load, "seed": seed, "error": "E" * (value is None), "seconds": 0.1, "key": "k"}
        | ({} if value is None else {"error_rms": value})
        for (policy, load), row in values.items()
        for seed, value in enumerate(row)
    ]
    return make_table(rows, ("policy", "load"), None, "made", None)


@settings(deadline=None)
@given(values=VALUES, confidence=st.floats(0.5, 0.999))
def test_the_interval_is_students(values, confidence):
    """As scipy.stats computes it; a constant has no width."""
    mean, sd, low, high = interval(np.array(values), confidence)
    np.testing.assert_allclose([mean, sd], [np.mean(values), np.std(values, ddof=1)])
    if sd > 1e-6:
        expected = stats.t.interval(confidence, len(values) - 1, mean, stats.sem(values))
        np.testing.assert_allclose([low, high], expected, rtol=1e-6, atol=1e-6)


def test_a_summary_keeps_the_order_of_the_design_and_counts_what_failed():
    """One run has no interval; no run has no mean."""
    table = result_of({("z", 1): [1.0, 3.0, None], ("a", 1): [5.0, None, None], ("m", 1): [None] * 3})
    summary = table.summary("error_rms", by="policy")
    assert summary["policy"].tolist() == ["z", "a", "m"]
    assert summary["n"].tolist() == [2, 1, 0] and summary["failed"].tolist() == [1, 2, 3]
    assert summary["mean"].tolist()[:2] == [2.0, 5.0] and np.isnan(summary["mean"][2])
    assert summary["low"][0] < 2 < summary["high"][0] and summary[["low", "high"]][1:].isna().all(axis=None)
    assert table.means("error_rms")["error_rms"].tolist()[:2] == [2.0, 5.0]


@settings(deadline=None)
@given(values=VALUES, shift=st.floats(-100, 100))
def test_a_comparison_pairs_the_seeds(values, shift):
    """A constant shift is found exactly, however much the values scatter: rows shuffled or not."""
    result = result_of({("even", 1): values, ("mine", 1): [value + shift for value in values]})
    (row,) = result.compare("error_rms", baseline="even").to_dict("records")
    assert row["policy"] == "mine" and row["n"] == len(values) and row["dropped"] == 0
    np.testing.assert_allclose([row["difference"], row["low"], row["high"]], shift, atol=1e-6)
    assert row["better"] == np.mean([value + shift < value for value in values])


def test_a_comparison_keeps_the_other_parameters_apart_and_drops_broken_pairs():
    """Each load is compared with the baseline at that load."""
    result = result_of(
        {("even", 1): [1.0, 1.0], ("even", 2): [10.0, None], ("mine", 1): [2.0, 4.0], ("mine", 2): [5.0, 5.0]}
    )
    table = result.compare("error_rms", baseline={"policy": "even"})
    assert table["load"].tolist() == [1, 2]
    assert table["difference"].tolist() == [2.0, -5.0] and table["ratio"].tolist() == [3.0, 0.5]
    assert table["n"].tolist() == [2, 1] and table["dropped"].tolist() == [0, 1]
    assert table["better"].tolist() == [0.0, 1.0]
    assert result.compare("error_rms", "even", higher_is_better=True)["better"].tolist() == [1.0, 0.0]
    one = result.compare("error_rms", baseline={"policy": "even", "load": 1})
    assert one["difference"].tolist()[1:] == [1.0 + 1.0, 4.0]  # every other point with this one


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda r: r.summary("error_rsm"), "unknown metric 'error_rsm'; did you mean 'error_rms'"),
        (lambda r: r.summary("error_rms", by="polcy"), "did you mean 'policy'"),
        (lambda r: r.summary("error_rms", confidence=95), "between 0 and 1"),
        (lambda r: r.compare("error_rms", "evn"), "unknown label 'evn'; did you mean 'even'"),
        (lambda r: r.compare("error_rms", {"policy": "evn"}), "unknown label of policy: 'evn'; did you mean 'even'"),
        (lambda r: r.compare("error_rms", {}), "names no parameter"),
        (lambda r: Study(draw, seeds=1).run().summary("text"), "'text' is text"),
    ],
)
def test_a_wrong_name_is_told_with_its_neighbour(ask, message):
    """Metrics, parameters, labels."""
    with pytest.raises(InputError, match=message):
        ask(result_of({("even", 1): [1.0, 2.0], ("mine", 1): [2.0, 3.0]}))


def test_a_label_of_two_parameters_has_to_name_its_own():
    """Else nobody knows which is meant."""
    result = make_table(
        [{"a": 1, "b": b, "seed": 0, "v": 1.0, "error": "", "seconds": 0.0, "key": ""} for b in (1, 2)],
        ("a", "b"),
        None,
        "made",
        None,
    )
    with pytest.raises(InputError, match="one of a and of b"):
        result.compare("v", 1)


def test_metrics_of_a_run_are_the_runs_own_numbers():
    """Counts, errors, gaps, times; a column has numbers or text, never both."""
    run = Reactor()(seed=0, policy=Periodic(0.25))
    row = Study(Reactor(), {"policy": [Periodic(0.25)]}, seeds=1).run().table.iloc[0]
    assert (row["samples"], row["solves"], row["failed_solves"]) == (run.samples, run.solves, 0)
    for name, value in {
        "online_rms": run.online_rms(),
        "retrospective_rms": run.retrospective_rms(),
        "ise": run.ise,
        "online_rms.pB": run.online_rms("pB"),
        "longest_gap": run.gaps.max(),
        "shortest_gap": run.gaps[1:].min(),
    }.items():
        assert row[name] == value
    assert 0 < row["solve_ms_median"] <= row["solve_ms_max"] <= 1e3 * row["solve_seconds_total"] <= 1e3 * row["seconds"]
    mixed = Study(lambda *, seed: {"v": "text" if seed else 1.5}, seeds=2).run()
    assert mixed.table["v"].tolist() == ["1.5", "text"]
    assert isinstance(mixed.table, pd.DataFrame) and "2 runs" in repr(mixed)


def test_differences_pool_the_pairs_of_all_other_parameters():
    """by="policy": every load and seed is a pair, each with the baseline's run at the same load and seed."""
    result = result_of(
        {("even", 1): [1.0, 2.0], ("odd", 1): [1.5, 2.1], ("even", 2): [5.0, 7.0], ("odd", 2): [5.2, None]}
    )
    (row,) = result.compare("error_rms", {"policy": "even"}, by="policy").to_dict("records")
    mean, _, low, high = interval(np.array([0.5, 0.1, 0.2]))
    assert (row["policy"], row["n"], row["dropped"]) == ("odd", 3, 1)
    np.testing.assert_allclose([row["difference"], row["low"], row["high"]], [mean, low, high])
    with pytest.raises(InputError, match="unknown parameter 'polcy'"):
        result.compare("error_rms", {"policy": "even"}, by="polcy")
