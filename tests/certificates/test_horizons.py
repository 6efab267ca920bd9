"""Horizons: what is returned meets its condition, one step less does not, and the literature's order is kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.comparison import compare_horizons
from ctmhe.certificates.excited_set import ExcitedSet
from ctmhe.certificates.horizon import aligned, contraction, longest_wait, shortest_horizon, smallest_horizon
from ctmhe.certificates.joint_horizons import joint_conditions, joint_horizon
from ctmhe.certificates.observers import ObserverFunction
from ctmhe.certificates.suboptimal_horizons import (
    Lipschitz,
    cost_factor,
    gamma_1,
    growth,
    observer_horizon,
    trajectory_horizon,
)
from ctmhe.certificates.weights import StateDetectability, joint_weights
from ctmhe.errors import InputError
from ctmhe.models.library import batch_reactor, three_species_discrete
from ctmhe.types import Bounds

settings.register_profile("horizons", deadline=None, max_examples=40)
settings.load_profile("horizons")

rates, ratios, seeds = st.floats(0.05, 0.99), st.floats(1.0, 1e4), st.integers(0, 2**32 - 1)


def definite(rng: np.random.Generator, n: int) -> np.ndarray:
    """A random positive definite matrix with eigenvalues between 0.01 and 100."""
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return basis @ np.diag(10 ** rng.uniform(-2, 2, n)) @ basis.T


# --- (3.29)-(3.31), Remark 3.7, Table 3.1 -----------------------------------------------------------------------


@given(ratio=ratios, eta=rates, wait=st.integers(0, 20))
def test_the_smallest_whole_horizon_contracts_and_one_less_does_not(ratio, eta, wait):
    """4 ratio eta^(N - wait) < 1 for N, and not for N - 1; rho of (3.31) says the same."""
    N = smallest_horizon(ratio, eta, wait=wait)
    assert 4 * ratio * eta ** (N - wait) < 1 <= 4 * ratio * eta ** (N - 1 - wait) * (1 + 1e-9)
    assert contraction(ratio, eta, horizon=N, wait=wait) < 1
    assert longest_wait(ratio, eta, horizon=N) > wait or N - shortest_horizon(ratio, eta) == pytest.approx(wait)


def test_at_the_limit_itself_nothing_contracts():
    """4 eta^N = 1 at N = 2 for eta = 1/2: three steps are needed."""
    assert shortest_horizon(1.0, 0.5) == pytest.approx(2.0)
    assert smallest_horizon(1.0, 0.5) == 3


@given(period=st.floats(0.01, 1.0), multiple=st.integers(1, 20), count=st.integers(1, 100), shift=st.floats(0.1, 0.9))
def test_equidistant_instants_are_aligned_with_multiples_of_their_distance_only(period, multiple, count, shift):
    """Remark 3.7: so is a horizon longer than the run, whose windows all start at 0."""
    instants = period * np.arange(1, count + 1)
    assert aligned(instants, multiple * period)
    assert aligned(instants, (multiple - shift) * period) == (count + shift <= multiple)
    assert aligned(instants, (count + shift) * period)


@given(seed=seeds, eta=rates)
def test_the_condition_of_this_package_asks_for_the_shortest_horizon(seed, eta):
    """Thesis 3.3: lambda_max(P_upper) / lambda_min(P_lower) >= lambda_max(P_upper, P_lower), and each C mu^N < 1."""
    rng = np.random.default_rng(seed)
    P = definite(rng, 3)
    certificate = DetectabilityCertificate(P, P + definite(rng, 3), np.eye(3), np.eye(1), eta, step=1.0)
    ours, *others = compare_horizons(certificate)
    assert ours.horizon == smallest_horizon(certificate.ratio, eta) <= min(row.horizon for row in others)
    for row in (ours, others[1], others[2]):
        assert row.C * row.mu**row.horizon < 1 <= row.C * row.mu ** (row.horizon - 1) * (1 + 1e-6)
    assert others[0].strict and others[0].mu > 0.75**0.25 and others[0].horizon >= 10  # "no smaller than N = 10"


def test_horizons_are_compared_in_discrete_time_only():
    """The literature has no results for continuous time; the error says what to do."""
    certificate = DetectabilityCertificate(np.eye(2), np.eye(2), np.eye(2), np.eye(1), 0.5)
    with pytest.raises(InputError, match="certify the discretised model"):
        compare_horizons(certificate)


# --- suboptimal estimators --------------------------------------------------------------------------------------


def pair(rng: np.random.Generator, eta_o: float, eta_s: float):
    """V_o and a U that is compatible with it (Assumption 4.4)."""
    low, high = definite(rng, 2), definite(rng, 2)
    observer = ObserverFunction(low, low + high, definite(rng, 2), definite(rng, 1), eta_o)
    system = DetectabilityCertificate(low / 2, low, np.diag([*rng.uniform(0.1, 10, 3)]), definite(rng, 1), eta_s)
    return observer, system


@given(seed=seeds, eta_o=st.floats(0.5, 0.95), N=st.integers(0, 8), projected=st.booleans(), data=st.data())
def test_the_observer_horizon_meets_its_condition_and_one_step_less_does_not(seed, eta_o, N, projected, data):
    """C(N) eta_o^T < 1 (4.44) with T >= N; projecting never shortens T."""
    observer, system = pair(np.random.default_rng(seed), eta_o, eta_o - 0.1)
    candidate = data.draw(st.sampled_from(({"L_f": 1.2}, {"kappa": 0.7}, {"kappa": 0.7, "discount": 1.0})))
    arguments = {"horizon": N, "L_h": 1.5, "projected": projected, **candidate}
    T, C = observer_horizon(observer, system, **arguments), growth(observer, system, **arguments)
    assert C * eta_o**T < 1 and T >= N
    assert T == N or C * eta_o ** (T - 1) * (1 + 1e-9) >= 1
    if projected:
        assert observer_horizon(observer, system, **{**arguments, "projected": False}) <= T


@given(seed=seeds, N=st.integers(1, 12), fade=st.floats(0.8, 2.0), L_f=st.floats(1.0, 1.5))
def test_cost_factors_are_the_sums_of_their_proofs(seed, N, fade, L_f):
    """(4.31) bounds sum of fade^(N-1-j) (j+1) L_f^(2j) by N times a geometric series, (4.50) is a geometric series."""
    observer, system = pair(np.random.default_rng(seed), 0.9, 0.8)
    steps = np.arange(N)
    output = 2 * float(system.R[0, 0]) * 1.5**2
    least = [np.linalg.eigvalsh(part)[0] for part in (observer.P_lower, observer.Q, observer.R)]
    by_system = cost_factor(observer, system, horizon=N, L_h=1.5, L_f=L_f, discount=fade)
    lower = output * max(1, *(1 / part for part in least)) / 0.9**N
    exact = lower * np.sum(fade ** (N - 1 - steps) * (steps + 1) * L_f ** (2 * steps))
    assert (
        exact * (1 - 1e-9)
        <= by_system
        == pytest.approx(lower * N * np.sum(fade ** (N - 1 - steps) * L_f ** (2 * steps)))
    )
    by_observer = cost_factor(observer, system, horizon=N, L_h=1.5, kappa=0.0, discount=fade)
    assert by_observer == pytest.approx(
        output * max(1, 1 / least[0], 1 / least[2]) * np.sum((fade / 0.9) ** (N - 1 - steps))
    )


@given(seed=seeds, eta=st.floats(0.5, 0.98), a=st.floats(-5, 3), filtering=st.booleans())
def test_gamma_stays_below_one_from_the_returned_horizon_on(seed, eta, a, filtering):
    """(4.91) holds at N_min and all that follow, and not one step before; a heavier prior never needs more."""
    rng = np.random.default_rng(seed)
    P = definite(rng, 2)
    observer = ObserverFunction(P, P, np.eye(2), np.eye(1), eta)
    N = trajectory_horizon(observer, 10**a * P, filtering=filtering)
    after = np.arange(N, 3 * N + 200)
    assert gamma_1(observer, 10**a * P, after + filtering, after, after).max() < 1
    assert gamma_1(observer, 10**a * P, N - 1 + filtering, N - 1, N - 1) >= 1
    assert trajectory_horizon(observer, 10**a * P / 2, filtering=filtering) >= N


def test_what_the_theorems_ask_for_is_demanded():
    """Compatible functions, one candidate, L_f >= 1, a discount not below eta_s; each error says which."""
    observer, system = pair(np.random.default_rng(0), 0.9, 0.8)
    common = {"horizon": 3, "L_h": 1.0}
    for arguments, match in (
        ({}, "give one of both"),
        ({"L_f": 1.1, "kappa": 1.0}, "give one of both"),
        ({"L_f": 0.9}, "take 1"),
        ({"kappa": 1.0, "discount": 0.5}, "must not fade faster"),
        ({"kappa": 1.0, "horizon": 2.5}, "whole number"),
    ):
        with pytest.raises(InputError, match=match):
            observer_horizon(observer, system, **{**common, **arguments})
    with pytest.raises(InputError, match=r"Assumption 4.4.*for_weights"):
        observer_horizon(observer.scaled(0.1), system, **common, kappa=1.0)
    with pytest.raises(InputError, match="symmetric and positive definite"):
        ObserverFunction(np.eye(2), np.diag([1.0, -1.0]), np.eye(2), np.eye(1), 0.9)
    with pytest.raises(InputError, match="P_lower must not exceed P_upper"):
        ObserverFunction(np.eye(2), np.eye(2) / 2, np.eye(2), np.eye(1), 0.9)
    with pytest.raises(InputError, match="eta must lie"):
        ObserverFunction(np.eye(2), np.eye(2), np.eye(2), np.eye(1), 1.0)


def test_lipschitz_constants_hold_between_random_points_and_are_those_of_the_thesis():
    """4.2.6: L_f = 1.032 (rounded up), L_h = 1.732; no pair of points has a steeper secant."""
    model = three_species_discrete()
    found = Lipschitz.of(model)
    assert found.rigorous
    assert found.f == pytest.approx(1.032, abs=1e-3) and found.h == pytest.approx(np.sqrt(3))
    rng = np.random.default_rng(1)
    x, z = rng.uniform(0, 3, (2, 200, 3))
    steps = [np.asarray(model.dynamics(0, p, [], np.zeros(4), [])).ravel() for p in (*x, *z)]
    secants = np.linalg.norm(np.subtract(steps[:200], steps[200:]), axis=1) / np.linalg.norm(x - z, axis=1)
    assert secants.max() <= found.f
    assert Lipschitz.of(batch_reactor(), Bounds(x=(0.1, 0.2))).f == 1.0  # not less: Assumption 4.5


# --- joint estimation -------------------------------------------------------------------------------------------


def joint(rng: np.random.Generator, varying: bool):
    """Random functions for states and parameters, and weights that are made of them."""
    P, S, B_p = definite(rng, 2), definite(rng, 1), np.array([[0.0, 1.0]])
    states = StateDetectability(P, P + definite(rng, 2), definite(rng, 1), np.eye(2), np.eye(1), rng.uniform(0.3, 0.9))
    excited = ExcitedSet(S, definite(rng, 2), np.eye(2), np.eye(1), rng.uniform(0.3, 0.9))
    weights = joint_weights(states, excited, scale=1.0, caution=rng.uniform(1, 5), B_p=B_p if varying else None)
    return weights, states, excited


@given(seed=seeds, varying=st.booleans())
def test_joint_conditions_hold_from_the_returned_horizon_on(seed, varying):
    """(5.38)-(5.40), or (5.100): they hold at N_min and far beyond, and not one step before."""
    parts = joint(np.random.default_rng(seed), varying)
    N = joint_horizon(*parts)
    assert all(joint_conditions(*parts, horizon=n) for n in (N, N + 1, N + 7, 2 * N, 5 * N, 40 * N))
    assert N == 1 or not joint_conditions(*parts, horizon=N - 1)
    assert 0 < joint_conditions(*parts, horizon=N).mu < 1


def test_without_contraction_of_the_states_nothing_is_claimed_of_the_rest():
    """Where (5.40) fails, c of (5.37) has no meaning: the other conditions fail with it."""
    parts = joint(np.random.default_rng(3), False)
    found = joint_conditions(*parts, horizon=1)
    assert found.bounded >= 1 and found.c == np.inf and not found


def test_weights_that_do_not_meet_their_assumption_are_refused():
    """States that were not scaled as for the weights: (5.13) is named."""
    weights, states, excited = joint(np.random.default_rng(0), False)
    with pytest.raises(InputError, match=r"\(5.13\): W is below"):
        joint_horizon(weights, states.scaled(3.0), excited)
    with pytest.raises(InputError, match="whole number"):
        joint_conditions(weights, states, excited, horizon=0)
