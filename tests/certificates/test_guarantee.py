"""The bounds of windows and of Theorem 3.1, as numbers."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.guarantee import Track, WindowBounds, largest_square

P = np.array([[2.0, 0.5], [0.5, 1.0]])


def bounds_of(step=None, eta=0.4, horizon=2.5, **others):
    """Bounds of a certificate with P_upper = 1.2 P_lower."""
    certificate = DetectabilityCertificate(P, 1.2 * P, np.eye(2), np.eye(1), eta, step=step)
    return WindowBounds(certificate, horizon, **{"supply": 0.3, **others})


def run(bounds, gaps, initial=5.0, share=1.0, problems=()):
    """Solve after each gap with a cost that is a share of what the truth can cost; return the bounds."""
    track, t, found = Track(0.0, initial), 0.0, []
    for k, gap in enumerate(gaps):
        t += gap
        start = max(t - bounds.horizon, 0.0)
        most = 2 * (bounds.fade(t - start) * bounds.before(track, start) + bounds.energy(t - start))
        track, bound = bounds.after(track, start, t, share * most, problems[k] if k < len(problems) else ())
        found.append(bound)
    return track, found


@settings(max_examples=60)
@given(
    gaps=st.lists(st.floats(0.02, 0.6), min_size=3, max_size=40),
    supply=st.floats(0, 2),
    cap=st.sampled_from([np.inf, 20.0]),
)
def test_the_theorem_follows_from_the_windows(gaps, supply, cap):
    """Even where every solve costs all that the truth can, the windows' bound is at most that of Theorem 3.1."""
    bounds = bounds_of(supply=supply, cap=cap)
    _, found = run(bounds, gaps)
    for bound in found:
        assert bound.level is not None and bound.level <= cap
        if bound.theorem is not None:
            assert min(bound.level, cap) <= bound.theorem * (1 + 1e-9)


@settings(max_examples=40)
@given(
    gaps=st.lists(st.floats(0.05, 0.4), min_size=12, max_size=40),
    bad=st.sets(st.integers(0, 39), max_size=4),
    supply=st.floats(0, 1),
)
def test_after_a_breach_the_theorem_starts_anew(gaps, bad, supply):
    """After windows without guarantee it holds again, with the domain's width to start from, and above the windows'."""
    bounds = bounds_of(supply=supply, cap=30.0)
    problems = [("lost",) if k in bad else () for k in range(len(gaps))]
    _, found = run(bounds, gaps, problems=problems)
    for k, bound in enumerate(found):
        if k in bad:
            assert bound.level is None and bound.theorem is None and bound.reasons == ("lost",)
        elif bound.theorem is not None:
            assert bound.level <= bound.theorem * (1 + 1e-9)


def test_without_a_bounded_domain_a_breach_hurts_windows_that_start_in_it():
    """Nothing bounds the error there: one bad window is overcome, bad ones over a horizon are not."""
    once = run(bounds_of(), [0.3] * 30, problems=[()] * 12 + [("lost",)])[1]
    hit = {12}  # and windows that start in the piece of one that is hit: (0.3 k, 0.3 (k + 1)] ends at solve k
    hit |= {k for k in range(13, 30) if round((0.3 * (k + 1) - 2.5) // 0.3) in hit}
    hit |= {k for k in range(13, 30) if round((0.3 * (k + 1) - 2.5) // 0.3) in hit}
    assert {k for k, bound in enumerate(once) if bound.level is None} == hit and len(hit) == 3
    assert all("nothing bounds" in " ".join(bound.reasons) for bound in once[13:])  # the theorem's chain may meet it
    for_good = run(bounds_of(), [0.3] * 40, problems=[()] * 12 + [("lost",)] * 9)[1]
    assert all(bound.size is None for bound in for_good[12:])


def test_equal_gaps_need_no_wait():
    """Remark 3.7: gaps of T / 5 beyond the limit of (3.29) keep the theorem, unequal ones lose it."""
    bounds = bounds_of(horizon=2.5)
    assert bounds.limit == pytest.approx(2.5 - np.log(4.8) / -np.log(0.4))
    gap = 1.25
    assert gap > bounds.limit
    assert all(bound.certified for bound in run(bounds, [gap] * 8)[1])
    unequal = run(bounds, [0.3, 0.3, gap, 0.2, 0.2])[1]
    assert [bound.certified for bound in unequal] == [True, True, False, True, True]
    assert f"waited {gap:g} s" in unequal[2].reasons[0]


def test_a_cost_above_the_truths_is_no_optimum():
    """A solve that costs more than the truth can is no solve of the theorem, but its own window's bound holds."""
    bound = run(bounds_of(), [0.2, 0.2], share=1.5)[1][-1]
    assert bound.theorem is None and "exceeds" in bound.reasons[0]
    assert bound.level is not None and bound.size == pytest.approx(np.sqrt(bound.level))


def test_a_short_horizon_guarantees_nothing():
    """The reason names the horizon of (3.30)."""
    bound = run(bounds_of(horizon=1.0), [0.1])[1][0]
    assert bound.theorem is None and "must exceed 1.71" in bound.reasons[0]


@given(sizes=st.lists(st.floats(0, 10), min_size=1, max_size=5), seed=st.integers(0, 10**6))
def test_the_largest_square_of_a_box(sizes, seed):
    """No point of the box exceeds it, and a corner attains it."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(len(sizes), len(sizes)))
    M, sizes = root @ root.T, np.array(sizes)
    largest = largest_square(M, sizes)
    inside = rng.uniform(-1, 1, (200, len(sizes))) * sizes
    assert np.einsum("ki,ij,kj->k", inside, M, inside).max() <= largest * (1 + 1e-9) + 1e-12
    signs = np.array(np.meshgrid(*[[-1, 1]] * len(sizes))).reshape(len(sizes), -1).T * sizes
    assert np.einsum("ki,ij,kj->k", signs, M, signs).max() == pytest.approx(largest, rel=1e-9, abs=1e-12)


def test_a_free_signal_matters_only_where_it_counts():
    """An unbounded entry makes the square infinite unless its row is zero."""
    assert largest_square(np.diag([1.0, 0.0]), np.array([2.0, np.inf])) == 4.0
    assert largest_square(np.eye(2), np.array([2.0, np.inf])) == np.inf


def test_steps_of_discrete_time_count_as_sums():
    """The energy of a constant disturbance over N steps is the geometric sum, whatever the length of a step."""
    bounds = bounds_of(step=0.1, eta=0.8, horizon=2.0)
    assert bounds.energy(0.5) == pytest.approx(0.3 * sum(0.8**j for j in range(5)))
    assert bounds_of(eta=0.8).energy(0.5) == pytest.approx(0.3 * (1 - 0.8**0.5) / -np.log(0.8))


def test_bounds_along_the_trajectory_grow_to_the_left():
    """On the piece of a solve the bound is eta^-(t_i - t) times that at t_i (3.20)."""
    bounds = bounds_of()
    track, _ = run(bounds, [0.2] * 10)
    for end, before in pairwise(reversed(track.ends)):
        middle = (end + before) / 2
        assert bounds.at(track, middle) == pytest.approx(bounds.at(track, end) / bounds.fade(end - middle))


def test_long_runs_end_in_no_underflow():
    """A breach after thousands of horizons is as good as one after ten."""
    bounds = bounds_of(cap=20.0)
    track = Track(0.0, 5.0)
    for k in range(1, 40):
        t = 5000.0 + 0.3 * k
        track, bound = bounds.after(track, t - 2.5, t, 0.0, ("lost",) if k == 20 else ())
    assert bound.level is not None and bound.level < 20.0


def test_gaps_that_drift_are_not_equal():
    """Gaps within the tolerance of each other whose windows do not start at solves have no sharper theorem."""
    bounds = bounds_of(horizon=2.0, slack=1e-3)
    track, t = Track(0.0, 5.0), 0.0
    for _ in range(60):
        t += 0.1 + 0.9e-3
        track, _bound = bounds.after(track, max(t - 2.0, 0.0), t, 0.0)
    assert np.isnan(track.period)


def test_a_rate_that_rounds_to_one_guarantees_nothing():
    """The wait is below its limit by rounding only."""
    eta = 0.7071067811865475
    certificate = DetectabilityCertificate(np.eye(1), np.eye(1), np.eye(1), np.eye(1), eta, step=1.0)
    bounds, track = WindowBounds(certificate, 6.0, 1.0, cap=10.0), Track(0.0, 10.0)
    for t in (2.0, 3.0, 5.0):
        track, bound = bounds.after(track, 0.0, t, 0.0)
    assert bound.level is not None
