"""Figures of a study's table: what is drawn is what the table says."""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.plotting import (
    plot_error_against_samples,
    plot_heatmap,
    plot_paired_differences,
    plot_pareto,
)
from ctmhe.statistics import interval, non_dominated

matplotlib.use("agg")


@pytest.fixture(autouse=True)
def closed():
    """Figures are closed after a test."""
    yield
    from matplotlib import pyplot

    pyplot.close("all")


def study(seeds=5, seed=0):
    """Return a table of two policies at three budgets."""
    rng = np.random.default_rng(seed)
    rows = [
        {"policy": policy, "budget": n, "seed": s, "samples": n + rng.integers(3), "online_rms": rng.uniform(1, 2) / n}
        for policy in ("even", "delta")
        for n in (10, 20, 50)
        for s in range(seeds)
    ]
    return pd.DataFrame(rows)


def legend(axes):
    """Return the legend's texts."""
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_a_line_runs_through_the_means_of_its_family():
    """Both coordinates are means over the seeds, in the order of the samples."""
    table = study()
    axes = plot_error_against_samples(table.sample(frac=1, random_state=0).sort_values("policy"), parameter="budget")
    lines = {text.split(" (")[0]: line.lines[0] for text, line in zip(legend(axes), axes.containers, strict=True)}
    for policy, line in lines.items():
        means = table[table.policy == policy].groupby("budget")[["samples", "online_rms"]].mean()
        np.testing.assert_allclose(line.get_xydata(), means.to_numpy())


def test_runs_that_failed_are_not_counted_in_n():
    """A family says how few runs stand behind its worst point."""
    table = study()
    table.loc[0, "online_rms"] = np.nan
    assert legend(plot_error_against_samples(table, parameter="budget")) == ["even (n = 4 to 5)", "delta (n = 5)"]


def test_a_single_run_has_no_interval():
    """And the axis does not claim one."""
    axes = plot_error_against_samples(study(seeds=1), parameter="budget")
    assert legend(axes) == ["even (n = 1)", "delta (n = 1)"]
    assert "interval" not in axes.get_ylabel()
    assert "95 % interval" in plot_error_against_samples(study(), parameter="budget").get_ylabel()


def test_families_differ_in_colour_marker_and_line():
    """Colour alone is not enough in grey."""
    axes = plot_error_against_samples(study(), parameter="budget")
    looks = [(c.lines[0].get_color(), c.lines[0].get_marker(), c.lines[0].get_linestyle()) for c in axes.containers]
    assert all(a != b for a, b in zip(*looks, strict=True))


def test_students_interval_covers_the_mean_as_often_as_it_says():
    """95 of 100, within four standard deviations of the count."""
    rng = np.random.default_rng(0)
    found = [interval(rng.normal(3.0, 2.0, 6)) for _ in range(2000)]
    share = np.mean([low <= 3.0 <= high for _, _, low, high in found])
    assert abs(share - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 2000)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=30))
def test_the_front_is_what_no_point_beats(points):
    """Every point off the front is beaten by one on it, none on it by any."""
    array = np.array(points, dtype=float)
    kept = non_dominated(array)
    beats = lambda a, b: bool((a <= b).all() and (a < b).any())  # noqa: E731
    assert kept.any()
    for point, on_front in zip(array, kept, strict=True):
        assert on_front != any(beats(other, point) for other in array[kept])


def test_a_point_with_a_nan_is_not_on_the_front():
    """A failed run cannot be the best."""
    assert non_dominated([[1.0, np.nan], [2.0, 2.0]]).tolist() == [False, True]


def test_the_staircase_lies_on_the_front():
    """It passes through each point of the front and no point lies under it."""
    table = study(seeds=1)
    axes = plot_pareto(table, x="samples", y="online_rms", by="policy")
    stairs = next(line for line in axes.lines if line.get_label() == "front").get_xydata()
    front = table[non_dominated(table[["samples", "online_rms"]].to_numpy())]
    for point in front[["samples", "online_rms"]].to_numpy():
        assert (np.abs(stairs - point).sum(axis=1) < 1e-12).any()
    assert sum(int(text.split("(")[1].split(" of")[0]) for text in legend(axes) if "(" in text) == len(front)


def test_a_heat_map_has_means_in_its_cells_and_crosses_where_there_are_none():
    """Numbers while the cells are few."""
    table = study()
    table.loc[(table.policy == "even") & (table.budget == 50), "online_rms"] = np.nan
    axes = plot_heatmap(table, x="budget", y="policy", value="online_rms")
    mean = table[(table.policy == "delta") & (table.budget == 20)].online_rms.mean()
    texts = [text.get_text() for text in axes.texts]
    assert f"{mean:.3g}" in texts and len(texts) == 5 and len(axes.lines) == 1
    many = pd.DataFrame([{"a": a, "b": b, "v": a + b} for a in range(20) for b in range(20)])
    assert not plot_heatmap(many, x="a", y="b", value="v").texts


def test_a_difference_whose_interval_holds_zero_is_drawn_open():
    """Filled markers are clear differences; rows keep their order and say their n."""
    comparison = pd.DataFrame(
        {
            "policy": ["delta", "late"],
            "budget": [10, 20],
            "difference": [-1.0, 0.1],
            "low": [-2.0, -0.3],
            "high": [-0.5, 0.5],
            "n": [20, 19],
        }
    )
    axes = plot_paired_differences(comparison)
    markers = [line.get_markerfacecolor() for line in axes.lines if line.get_marker() not in ("", "None")]
    assert markers[0] != "white" and markers[1] == "white"
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == ["delta, budget = 10 (n = 20)", "late, budget = 20 (n = 19)"]


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda t: plot_error_against_samples(t, by="polcy"), "no column 'polcy'; did you mean 'policy'"),
        (
            lambda t: plot_error_against_samples(t.assign(online_rms=np.nan)),
            "no run has a finite samples and online_rms",
        ),
        (lambda t: plot_pareto(t, x="samples", y="rms"), "no column 'rms'"),
        (lambda t: plot_heatmap(t.assign(v=np.nan), x="budget", y="policy", value="v"), "no run has a finite v"),
        (plot_paired_differences, "no column 'difference'"),
    ],
)
def test_what_cannot_be_drawn_is_an_error(draw, message):
    """Columns are named with the nearest known one."""
    with pytest.raises(InputError, match=message):
        draw(study())


def test_axes_that_are_given_are_drawn_into():
    """Nothing is opened beside them."""
    from matplotlib import pyplot

    axes = pyplot.figure().add_subplot()
    assert plot_error_against_samples(study(), axes) is axes and len(pyplot.get_fignums()) == 1
