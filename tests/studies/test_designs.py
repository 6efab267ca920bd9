"""Designs: what is tried, and how it is called."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe import MaxInterval, Periodic
from ctmhe.errors import InputError
from ctmhe.studies import Design, Study, from_table, full_grid, latin_hypercube, sobol


@settings(deadline=None)
@given(st.lists(st.integers(1, 4), min_size=1, max_size=3))
def test_a_full_grid_holds_every_combination_once_the_last_parameter_varying_first(sizes):
    """As nested loops would."""
    design = full_grid({f"p{i}": range(n) for i, n in enumerate(sizes)})
    assert design.labels == tuple(np.ndindex(*sizes))


def test_labels_are_what_people_read():
    """Numbers, text and booleans are their own labels, objects are called by repr, a mapping names its values."""
    design = full_grid({"a": [1, np.float64(2.5)], "b": [Periodic(0.1)], "c": {"loose": None}, "d": [True, "yes"]})
    assert design.labels[0] == (1.0, "Periodic(period=0.1)", "loose", "True")
    assert next(iter(design)) == {"a": 1, "b": Periodic(0.1), "c": None, "d": True}


@pytest.mark.parametrize("make", [latin_hypercube, sobol])
@settings(deadline=None)  # the first call imports scipy.stats
@given(points=st.integers(1, 20), seed=st.integers(0, 1000))
def test_space_filling_designs_stay_in_their_ranges_and_repeat(make, points, seed):
    """The same seed gives the same points; logarithmic ranges too."""
    space = {"a": (-1.0, 2.0), "b": (1e-3, 1e2)}
    design = make(space, points, seed, log=["b"])
    values = np.array(design.values)
    assert (values.min(axis=0) >= [-1, 1e-3]).all() and (values.max(axis=0) <= [2, 1e2]).all()
    assert design.labels == make(space, points, seed, log=["b"]).labels


@settings(deadline=None)
@given(points=st.integers(2, 30))
def test_a_latin_hypercube_meets_every_slice_of_every_range_once(points):
    """Its defining property, on the logarithmic scale where asked."""
    values = np.array(latin_hypercube({"a": (0, 1), "b": (1, 10)}, points, 3, log=["b"]).values)
    slices = np.floor(points * np.column_stack([values[:, 0], np.log10(values[:, 1])])).astype(int)
    assert (np.sort(slices, axis=0) == np.arange(points)[:, None]).all()


@settings(deadline=None)
@given(few=st.integers(1, 9), more=st.integers(0, 30))
def test_a_longer_sobol_design_begins_with_the_shorter(few, more):
    """So that a study can be extended."""
    assert sobol({"a": (0, 1)}, few + more, 1).labels[:few] == sobol({"a": (0, 1)}, few, 1).labels


def test_a_table_may_be_a_data_frame_and_designs_multiply():
    """Rows are points; `a * b` combines."""
    rows = [{"a": 1, "b": "x"}, {"a": 2, "b": "y"}]
    assert from_table(pd.DataFrame(rows)).labels == from_table(rows).labels == ((1, "x"), (2, "y"))
    both = from_table(rows) * full_grid({"c": [0.5]})
    assert both.parameters == ("a", "b", "c") and both.labels[1] == (2, "y", 0.5)
    study = Study(lambda *, seed, a, b, c: {}, {"c": [0.5]}, 1, design=from_table(rows))
    assert study.design.parameters == ("c", "a", "b")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: full_grid({"policy": [MaxInterval(1.0), MaxInterval(1.0)]}), "two points are called policy='MaxI"),
        (lambda: full_grid({"a": []}), "a has no values"),
        (lambda: full_grid({"a": 3}), "a: expected a list of values"),
        (lambda: full_grid({"a": [float("nan")]}), "NaN cannot be a value"),
        (lambda: full_grid({"seed": [1]}), "cannot be called 'seed'"),
        (lambda: full_grid({"two words": [1]}), "'two words' cannot be one"),
        (lambda: full_grid({"a": {None: 1}}), "labels are text or numbers"),
        (lambda: full_grid({"a": [1]}) * full_grid({"a": [2]}), "named twice"),
        (lambda: from_table([{"a": 1}, {"b": 2}]), "name the same parameters"),
        (lambda: from_table([]), "sequence of mappings"),
        (lambda: latin_hypercube({"a": (1, 0)}, 3), "a: a range needs low < high"),
        (lambda: sobol({"a": (0, 1)}, 3, log=["a"]), "0 < low < high"),
        (lambda: sobol({"a": (0, 1)}, 3, log=["b"]), "log names 'b'"),
        (lambda: sobol({"a": (0, 1)}, 0), "points must be a whole number"),
        (lambda: Design((), (), ()), "there are no points"),
        (lambda: Study(lambda *, seed: {}, 3), "expected a mapping"),
    ],
)
def test_a_design_that_is_none_is_told_by_name(make, message):
    """Every mistake names the parameter."""
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        make()
