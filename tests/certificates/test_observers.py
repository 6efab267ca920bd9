"""Designed observers: their function falls along every pair of trajectories, in both times; printed ones are judged."""

from __future__ import annotations

import json
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.increments import Increments
from ctmhe.certificates.injection import Units
from ctmhe.certificates.observers import ObserverFunction, design_observer, observer_margin, split_disturbances
from ctmhe.errors import CertificateError, InputError
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.continuous import box_arrays
from ctmhe.models.library import batch_reactor, chua, three_species, three_species_discrete
from ctmhe.studies.reproduce import printed_observers
from ctmhe.types import Bounds

settings.register_profile("observers", deadline=None, max_examples=25)
settings.load_profile("observers")

CASES = {
    "three_species, Euler": (three_species_discrete, printed_observers.SPECIES_DOMAIN, 0.97),
    "three_species": (three_species, printed_observers.SPECIES_DOMAIN, 0.9),
    "batch_reactor, Euler": (printed_observers.reactor_discrete, printed_observers.REACTOR_DOMAIN, 0.955),
    "batch_reactor": (batch_reactor, printed_observers.REACTOR_DOMAIN, 0.6),
    "chua": (lambda: chua(parameters=()), None, 0.5),
    "chua, any p": (chua, None, 0.7),
}
discrete, continuous = ([name for name in CASES if ("Euler" in name) == kind] for kind in (True, False))


@cache
def observer(name: str):
    model, domain, eta = CASES[name]
    return design_observer(model(), domain, eta=eta)


def pair(found, seed: int):
    """Random z, x in the domain and w, p in their bounds; unbounded states within one nominal of zero."""
    rng, model = np.random.default_rng(seed), found.model
    low, high = box_arrays(model.x, found.domain.x, "x")
    low = np.where(np.isfinite(low), low, -model.x.nominal)
    high = np.where(np.isfinite(high), high, model.x.nominal)
    z, x = rng.uniform(low, high, (2, len(low)))
    w = rng.uniform(-1, 1, len(model.w)) * model.w.nominal * 10 ** rng.uniform(-3, 1)
    p = rng.uniform(*box_arrays(model.p, model.bounds.p, "p")) if len(model.p) else np.empty(0)
    return z, x, w, p


def sides(found, seed: int):
    """z ahead, x ahead, the error, and what disturbances supply."""
    z, x, w, p = pair(found, seed)
    y = np.asarray(found.model.output(0.0, x, [], w, p)).ravel()
    d, v = (np.array([w[found.model.w.index(name)] for name in names]) for names in (found.process, found.noise))
    supply = d @ found.function.Q @ d + v @ found.function.R @ v
    ahead = np.asarray(found.model.dynamics(0.0, x, [], w, p)).ravel()
    return found.advance(z, y=y, p=p) - ahead, z - x, supply


@pytest.mark.parametrize("name", discrete)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_function_falls_along_every_step(name, seed):
    """(4.6b), evaluated with the model's own functions: V_o(z+, x+) <= eta V_o(z, x) + |d|^2_Q + |v|^2_R."""
    found = observer(name)
    P, eta = found.function.P_upper, found.function.eta
    after, before, supply = sides(found, seed)
    assert after @ P @ after <= (eta * before @ P @ before + supply) * (1 + 1e-9)


@pytest.mark.parametrize("name", continuous)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_derivative_of_the_function_is_bounded(name, seed):
    """dV_o/dt = 2 e' P de/dt <= ln(eta) V_o + |d|^2_Q + |v|^2_R."""
    found = observer(name)
    P, eta = found.function.P_upper, found.function.eta
    change, error, supply = sides(found, seed)
    size = abs(error @ P @ change) + supply
    assert 2 * error @ P @ change <= np.log(eta) * error @ P @ error + supply + 1e-9 * size


@pytest.mark.parametrize("name", CASES)
def test_a_design_is_verified_and_says_how(name):
    """Polynomial models: a proof on the domain, margins not negative, d and v told apart, P at least one."""
    found = observer(name)
    assert found.rigorous and found.method in {"vertices", "bernstein"} and found.margin >= 0
    assert found.process == found.model.w.names[:-1] and found.noise == found.model.w.names[-1:]
    assert set(found.worst) >= set(found.model.x.names)
    x = np.diag(found.model.x.nominal)
    assert np.linalg.eigvalsh(x @ found.function.P_lower @ x)[0] >= 1 - 1e-6
    assert found.kappa == pytest.approx(np.linalg.norm(found.K))  # one output


def test_an_observer_forgets_its_start_and_stays_in_its_bound():
    """200 steps from the poor guess of 4.2.6, disturbed: V_o stays below the solution of V+ = eta V + supply."""
    found = observer("three_species, Euler")
    model, rng = found.model, np.random.default_rng(0)
    x, z = np.array([0.5, 0.05, 0.1]), np.array([2.0, 0.5, 0.0])
    P, limit = found.function.P_upper, (z - x) @ found.function.P_upper @ (z - x)
    start = limit
    for _ in range(200):
        w = rng.uniform(-1, 1, 4) * [1e-3, 1e-3, 1e-3, 0.05]
        y = np.asarray(model.output(0.0, x, [], w, [])).ravel()
        z, x = found.advance(z, y=y), np.asarray(model.dynamics(0.0, x, [], w, [])).ravel()
        limit = found.function.eta * limit + w[:3] @ found.function.Q @ w[:3] + w[3:] @ found.function.R @ w[3:]
        assert (z - x) @ P @ (z - x) <= limit
    assert (z - x) @ P @ (z - x) < 1e-2 * start


def test_designs_do_not_depend_on_the_units():
    """The same plant in other units has the same gain, converted."""

    def plant(unit):
        return DiscreteModel(
            lambda t, x, u, w, p: [0.9 * x[0] + 0.3 * unit * x[1] + unit * w[0], 1.05 * x[1]],
            lambda t, x, u, w, p: x[0] / unit + w[1],
            step=1.0,
            x=("a", "b"),
            w=("push", "noise"),
            y="gauge",
            nominal={"a": unit},
        )

    small, large = (design_observer(plant(unit), eta=0.8) for unit in (1.0, 1e4))
    np.testing.assert_allclose(large.K.ravel() / [1e4, 1.0], small.K.ravel(), rtol=1e-3)


def test_an_infeasible_rate_names_itself_and_a_remedy():
    """A mode that no output sees does not fade faster than it does: 0.9 a step, squared."""
    hidden = DiscreteModel(
        lambda t, x, u, w, p: [0.5 * x[0], 0.9 * x[1] + w[0]],
        lambda t, x, u, w, p: x[0] + w[1],
        step=1.0,
        x=("seen", "hidden"),
        w=("push", "noise"),
        y="gauge",
    )
    assert design_observer(hidden, eta=0.85).margin >= 0
    with pytest.raises(CertificateError, match=r"no constant gain at eta = 0.8 .*try a slower rate"):
        design_observer(hidden, eta=0.8)
    for eta in (0.0, 1.0, 1.5, float("nan")):
        with pytest.raises(InputError, match=r"design_observer: eta must lie in \(0, 1\)"):
            design_observer(hidden, eta=eta)
    with pytest.raises(InputError, match=r"'cB'.*without finite bounds"):
        design_observer(three_species_discrete(), Bounds(x={"cC": (0, 1)}), eta=0.97)


def test_a_pendulum_is_covered_by_intervals():
    """Sines: a proof, and the law at random points; a range of w without zero is extended to it."""
    pendulum = ContinuousModel(
        lambda t, x, u, w, p: [x[1], -ca.sin(x[0]) - 0.1 * x[1] + w[0]],
        lambda t, x, u, w, p: x[0] + 0.1 * ca.sin(w[1]),
        x=("angle", "rate"),
        w=("push", "noise"),
        y="gauge",
        bounds=Bounds(x={"angle": (-1, 1)}, w={"noise": (0.5, 1.0)}),
    )
    found = design_observer(pendulum, eta=0.5)
    assert found.method == "interval" and found.rigorous and found.margin >= 0
    rng = np.random.default_rng(0)
    P = found.function.P_upper
    for _ in range(200):
        z, x, w = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2), np.array([rng.normal(), rng.uniform(0.5, 1)])
        y = np.asarray(pendulum.output(0.0, x, [], w, [])).ravel()
        change = found.advance(z, y=y) - np.asarray(pendulum.dynamics(0.0, x, [], w, [])).ravel()
        supply = found.function.Q[0, 0] * w[0] ** 2 + found.function.R[0, 0] * w[1] ** 2
        assert 2 * (z - x) @ P @ change <= np.log(0.5) * (z - x) @ P @ (z - x) + supply


def test_a_wrong_function_has_a_negative_margin():
    """Half the supply of an active design, or a faster rate, is refuted on the cover."""
    found = observer("three_species, Euler")
    domain = Bounds(x=found.domain.x, w=found.model.bounds.w)
    points = Increments(found.model, domain).cover("ABCD").jacobians
    process, noise = split_disturbances(points)
    V = found.function

    def margin(function):
        units = Units.of(found.model)
        return observer_margin(units, function, found.K, points, process=process, noise=noise).min()

    assert margin(V) >= 0
    assert margin(ObserverFunction(V.P_lower, V.P_upper, V.Q / 2, V.R, V.eta)) < 0
    assert margin(ObserverFunction(V.P_lower, V.P_upper, V.Q, V.R, V.eta - 0.01)) < 0


# --- what the thesis prints -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rows():
    return printed_observers.rows()


def test_rows_are_json_with_the_common_fields(rows):
    """What the case of all printed certificates collects."""
    stored = json.loads(json.dumps(rows))
    assert set(stored) == {"thesis 4.2.6", "thesis 4.3.3"}
    assert all({"published", "ours", "comment"} <= set(row) for row in stored.values())


def test_4_2_6_holds_within_rounding_but_for_u_where_the_observer_lives(rows):
    """V_o misses by rounding, U holds on X and not on O."""
    ours = rows["thesis 4.2.6"]["ours"]
    assert -1e-6 < ours["observer"]["margin"] < 0 < ours["observer"]["best_within_rounding_of_P"]
    assert ours["observer"]["smallest_eta"] == pytest.approx(0.97, abs=1e-6)
    assert ours["system"]["margin"] >= 0 and ours["system"]["smallest_eta"] == pytest.approx(0.9383, abs=1e-5)
    outside = ours["system_where_the_observer_lives"]
    assert outside["best_within_rounding_of_P"] < 0 and outside["smallest_eta"] > 0.97


def test_4_3_3_has_a_gain_that_cannot_have_its_rate_and_ours_can(rows):
    """A + K C at pA = 0.1 by hand: its slowest mode is above 0.955, for every K that rounds to the print."""
    ours = rows["thesis 4.3.3"]["ours"]
    K, pA = printed_observers.REACTOR.K, 0.1
    A = np.array([[1 - 0.4 * 0.16 * pA, 0.2 * 0.0064], [0.2 * 0.16 * pA, 1 - 0.1 * 0.0064]])
    by_hand = np.abs(np.linalg.eigvals(A + K @ np.ones((1, 2)))).max() ** 2
    assert ours["observer"]["factor_that_K_allows"] == pytest.approx(by_hand)
    assert ours["observer"]["factor_that_its_rounding_allows"] > 0.955
    assert ours["observer"]["best_within_rounding_of_P"] < 0
    assert ours["system"]["margin"] < 0 < ours["system"]["best_within_rounding_of_P"]
    assert ours["own_design"]["eta_o"] == 0.955 and ours["own_design"]["rigorous"] and ours["own_design"]["margin"] >= 0
