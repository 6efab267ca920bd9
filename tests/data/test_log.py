"""Logs: persistent inside the estimator, checked when they come from files."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.data import Log, MeasurementLog
from ctmhe.data.window import held_inputs, held_signal
from ctmhe.errors import InputError

times = st.floats(-10, 10, allow_nan=False).map(lambda t: round(t, 3))


@given(st.lists(st.tuples(times, st.floats(-5, 5)), max_size=40), st.integers(0, 40), times)
def test_a_log_is_an_ordered_map_whose_old_versions_stay(entries, keep, cut):
    """Against a plain dict: order, replacement, lookup, dropping; a branch taken earlier is untouched."""
    log, model, branch, branch_model = Log(1), {}, Log(1), {}
    for i, (t, value) in enumerate(entries):
        if i == keep:
            branch, branch_model = log, dict(model)
        log = log.put(t, np.array([value]))
        model[t] = value
    for one, truth in ((log, model), (branch, branch_model)):
        t, rows = one.arrays()
        np.testing.assert_array_equal(t, sorted(truth))
        np.testing.assert_array_equal(rows[:, 0], [truth[k] for k in sorted(truth)])
    assert all(log.find(t) is not None for t in model)
    later = [t for t in sorted(model) if t >= cut]
    np.testing.assert_array_equal(log.drop_before(cut).arrays()[0], later)
    holding = log.drop_before(cut, keep_holding=True).arrays()[0]
    before = [t for t in sorted(model) if t < cut]
    expected = later if (cut in model or not before) else [before[-1], *later]
    np.testing.assert_array_equal(holding, expected)


def frame():
    """A small table as a plant historian writes it."""
    return pd.DataFrame({"t": [0.0, 1.0, 2.5], "p_bar": [1.0, np.nan, 1.2], "valve": [0.1, 0.2, 0.3]})


def test_columns_become_named_signals(tmp_path):
    """Mapping of names, missing outputs, units; CSV gives what the DataFrame gives."""
    keywords = dict(outputs={"pressure": "p_bar"}, inputs=["valve"], units={"pressure": "bar"})
    frame().to_csv(tmp_path / "log.csv", index=False)
    for log in (
        MeasurementLog.from_dataframe(frame(), **keywords),
        MeasurementLog.from_csv(tmp_path / "log.csv", **keywords),
    ):
        assert log.outputs == ("pressure",) and log.inputs == ("valve",) and len(log) == 3
        np.testing.assert_array_equal(log.t, [0, 1, 2.5])
        np.testing.assert_array_equal(log.y[:, 0], [1.0, np.nan, 1.2])
        assert log.units == {"pressure": "bar"}


def test_times_are_converted_to_seconds():
    """Minutes, and datetimes from the first row on."""
    minutes = MeasurementLog.from_dataframe(frame(), outputs={"p": "p_bar"}, time_unit="min")
    np.testing.assert_allclose(minutes.t, [0, 60, 150])
    stamped = frame().assign(
        t=pd.to_datetime(["2024-01-01 10:00:00.0", "2024-01-01 10:00:01.0", "2024-01-01 10:00:02.5"])
    )
    np.testing.assert_allclose(MeasurementLog.from_dataframe(stamped, outputs={"p": "p_bar"}).t, [0, 1, 2.5])


@pytest.mark.parametrize(
    ("change", "keywords", "message"),
    [
        ({}, {"outputs": ["p"]}, r"no column 'p'\. Columns: t, p_bar, valve"),
        ({"t": [0.0, 2.0, 1.0]}, {}, "row 2 has t = 1.0 after 2.0"),
        ({"t": [0.0, 1.0, 1.0]}, {}, "times must increase strictly"),
        ({"t": [0.0, np.nan, 1.0]}, {}, "time is not finite in row 1"),
        ({"p_bar": [1.0, np.inf, 2.0]}, {}, "'p_bar' is inf at t = 1.0"),
        ({"p_bar": ["1", "two", "3"]}, {}, "column 'p_bar' holds values that are not numbers"),
        ({"valve": [0.1, np.nan, 0.3]}, {"inputs": ["valve"]}, "'valve' is nan at t = 1.0"),
        ({}, {"time_unit": "fortnight"}, "time_unit must be one of"),
    ],
)
def test_bad_tables_are_refused_with_the_row(change, keywords, message):
    """Each mistake names the column and the row or time."""
    with pytest.raises(InputError, match=message):
        MeasurementLog.from_dataframe(frame().assign(**change), **({"outputs": ["p_bar"]} | keywords))


def test_dates_in_a_csv_are_seconds_since_the_first_row(tmp_path):
    """In ISO 8601, with or without parts of a second or a zone; a clock put back by an hour is no step back."""
    path = tmp_path / "log.csv"
    path.write_text("when,p\n2024-10-27T02:30:00+02:00,1\n2024-10-27T02:59:59.5+02:00,2\n2024-10-27T02:30:00+01:00,3\n")
    np.testing.assert_array_equal(MeasurementLog.from_csv(path, outputs="p", time="when").t, [0.0, 1799.5, 3600.0])
    path.write_text("when,p\n2025-01-13 00:00:00,1\n2025-01-13 00:04:03.25,2\n")
    np.testing.assert_array_equal(MeasurementLog.from_csv(path, outputs="p", time="when").t, [0.0, 243.25])
    path.write_text("when,p\nyesterday,1\ntoday,2\n")
    with pytest.raises(InputError, match="'when' holds neither numbers nor dates like 2025-01-31 08:15:00"):
        MeasurementLog.from_csv(path, outputs="p", time="when")


def test_missing_and_damaged_files_are_input_errors(tmp_path):
    """No file; not a table."""
    with pytest.raises(InputError, match="no file"):
        MeasurementLog.from_csv(tmp_path / "none.csv", outputs=["p"])
    (tmp_path / "bad.csv").write_bytes(b'"a,b\n1,2\n')
    with pytest.raises(InputError):
        MeasurementLog.from_csv(tmp_path / "bad.csv", outputs=["p"])


def test_inputs_and_signals_between_samples():
    """Zero hold steps, linear hold interpolates and then holds; before the first sample nothing is known."""
    times, edges = np.array([0.0, 1.0]), np.array([0.0, 0.5, 1.0, 2.0])
    u = np.array([[0.0], [2.0]])
    zero = held_inputs(times, u, edges, 1e-9, False)
    np.testing.assert_array_equal(zero[0][:, 0], [0, 0, 2])
    np.testing.assert_array_equal(zero[1][:, 0], [0, 0, 2])
    linear = held_inputs(times, u, edges, 1e-9, True)
    np.testing.assert_array_equal(linear[0][:, 0], [0, 1, 2])
    np.testing.assert_array_equal(linear[1][:, 0], [1, 2, 2])
    starts = np.array([-0.5, 0.0, 1.0])
    at = starts[:, None] + np.array([[0.0, 0.5]])
    value, known = held_signal(times, np.array([3.0, 5.0]), at, starts, 1e-9, 10.0, True)
    np.testing.assert_array_equal(known, [[False, False], [True, True], [True, True]])
    np.testing.assert_array_equal(value[1:], [[3.0, 4.0], [5.0, 5.0]])
