"""Disturbances: the same values whoever asks, in any order, with the distribution they promise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.models.signals import Signals
from ctmhe.simulation import Gaussian, Recorded, Uniform, Waveform
from ctmhe.simulation.signals import bind_disturbance, bind_inputs

W = Signals.of("disturbance", ("d1", "d2", "v"))


def at(driver, t):
    """Return the value on the cell around `t`."""
    return driver.segment(t - 1e-7, t + 1e-7)[0]


@given(st.integers(0, 2**62), st.permutations(list(range(-3, 600, 60))))
@settings(max_examples=20, deadline=None)
def test_a_cell_has_its_value_whoever_asks_first(seed, cells):
    """Random access: the value of cell k depends on seed, k and name only, not on the order of questions."""
    one, other = (bind_disturbance(Uniform(1.0, interval=0.1), W, seed) for _ in range(2))
    values = {k: at(one, (k + 0.5) * 0.1) for k in sorted(cells)}
    for k in cells:
        np.testing.assert_array_equal(at(other, (k + 0.5) * 0.1), values[k])


def test_a_name_has_its_values_whatever_stands_beside_it():
    """Signals are seeded by name: leaving one out, or reordering, changes no other."""
    both = bind_disturbance(Gaussian(1.0, interval=0.1), W, 5)
    alone = bind_disturbance({"v": Gaussian(1.0, interval=0.1)}, W, 5)
    for t in (0.05, 3.05, 77.75):
        assert at(both, t)[2] == at(alone, t)[2]
        assert (at(alone, t)[:2] == 0).all()
        assert len(set(at(both, t))) == 3


def test_values_follow_their_distribution():
    """Mean and spread of 20000 cells, within five standard errors; cells are independent of each other."""
    k = np.arange(20000) + 0.5
    for process, std in ((Uniform(2.0, interval=1.0), 2 / np.sqrt(3)), (Gaussian(0.7, interval=1.0), 0.7)):
        driver = bind_disturbance(process, W, 1)
        values = np.array([at(driver, t) for t in k])
        assert (np.abs(values.mean(axis=0)) < 5 * std / np.sqrt(len(k))).all()
        assert (np.abs(values.std(axis=0) / std - 1) < 5 / np.sqrt(len(k))).all()
        correlation = np.corrcoef(values[:-1, 0], values[1:, 0])[0, 1]
        assert abs(correlation) < 5 / np.sqrt(len(k))
    driver = bind_disturbance(Uniform(low=[1, 2, 3], high=[1, 3, 5]), W, 1)
    values = np.array([at(driver, t) for t in k[:1000]])
    assert (values >= [1, 2, 3]).all() and (values <= [1, 3, 5]).all()


@given(st.integers(1, 10**7), st.sampled_from([0.01, 0.05, 0.1, 1 / 3, 0.7]))
def test_jumps_are_absolute_multiples_of_the_interval(k, interval):
    """The jump after k * interval, however it was rounded, is (k + 1) * interval."""
    driver = bind_disturbance(Uniform(1.0, interval=interval), W, 0)
    for t in (k * interval, np.nextafter(k * interval, 0), np.nextafter(k * interval, np.inf)):
        assert driver.next_jump(t) == pytest.approx((k + 1) * interval, rel=1e-15)


def test_recorded_signals_hold_or_interpolate():
    """Zero hold is right-continuous; linear runs between the records; outside, the end values hold."""
    u = Signals.of("input", ("a", "b"))
    t, values = [0.0, 1.0, 3.0], np.array([[0.0, 1.0], [2.0, 1.0], [6.0, 5.0]])
    held = bind_inputs(Recorded(t, values), u, 0.1)
    np.testing.assert_array_equal(at(held, 1.5), [2.0, 1.0])
    np.testing.assert_array_equal(at(held, 9.0), [6.0, 5.0])
    np.testing.assert_array_equal(at(held, -1.0), [0.0, 1.0])
    assert [held.next_jump(s) for s in (-1.0, 0.0, 0.5, 1.0, 3.0)] == [0.0, 1.0, 1.0, 3.0, np.inf]
    start, end = bind_inputs(Recorded(t, values, hold="linear"), u, 0.1).segment(1.5, 2.0)
    np.testing.assert_allclose([start, end], [[3.0, 2.0], [4.0, 3.0]])
    named = bind_inputs(Recorded(t, {"b": [1.0, 2.0, 3.0]}), u, 0.1)
    np.testing.assert_array_equal(at(named, 1.5), [0.0, 2.0])


def test_a_waveform_is_held_at_the_middle_of_its_cells():
    """Cell [0.2, 0.4) has the value at 0.3."""
    driver = bind_disturbance({"d2": Waveform(lambda t: t**2, interval=0.2), "d1": 3.0}, W, 0)
    np.testing.assert_allclose(at(driver, 0.21), [3.0, 0.09, 0.0])


@pytest.mark.parametrize(
    "make",
    [
        lambda: Uniform(low=1.0),
        lambda: Uniform(1.0, low=0.0, high=1.0),
        lambda: Uniform(1.0, interval=0.0),
        lambda: Uniform(low=1.0, high=0.0).bind(W, 0),
        lambda: Uniform([1.0, 2.0]).bind(W, 0),
        lambda: Gaussian(-1.0).bind(W, 0),
        lambda: Recorded([1.0, 1.0], [0.0, 0.0]),
        lambda: Recorded([0.0, 1.0], [0.0, 0.0], hold="cubic"),
        lambda: Recorded([0.0, 1.0], [0.0, 0.0, 1.0]).bind(W, 0),
        lambda: bind_disturbance({"w3": Uniform(1.0)}, W, 0),
        lambda: bind_disturbance(0.1, W, 0),
        lambda: bind_disturbance(Recorded([0.0], [[0.0, 0.0, 0.0]], hold="linear"), W, 0),
        lambda: bind_disturbance(Uniform(1.0), Signals.of("disturbance", ()), 0),
        lambda: bind_inputs(None, Signals.of("input", "a"), 0.1),
        lambda: bind_inputs([np.inf], Signals.of("input", "a"), 0.1),
    ],
)
def test_signals_that_make_no_sense_are_refused(make):
    """Every wrong setting raises an InputError before the run starts."""
    with pytest.raises(InputError):
        make()
