"""Bounds that a review once refuted, each by its shortest run: the true error stays below, or there is no bound."""

from functools import cache

import numpy as np
import pytest

from ctmhe import MHE, Bounds, DiscountedCost, DiscreteModel, Guarantee, Input, Measurement
from ctmhe.certificates import (
    ExcitationMonitor,
    JointGuarantee,
    certify_detectability,
    design_excitation,
    design_observer,
    detect_states,
    joint_weights,
)
from ctmhe.estimators import ExcitedPrior, Suboptimal

BOX = Bounds(x=(-10.0, 10.0), w=(-1.0, 1.0))


@cache
def unstable():
    """x+ = 2 x + d, its observer and certificate."""
    model = DiscreteModel(
        lambda t, x, u, w, p: [2 * x[0] + w[0]], lambda t, x, u, w, p: [x[0] + w[1]],
        step=1.0, x=["a"], w=["d", "v"], y=["y"],
    )  # fmt: skip
    certificate = certify_detectability(model, eta=0.5, P=1.0, Q=[1e4, 1e4], R=3.6)
    return model, design_observer(model, eta=0.5), certificate


def suboptimal(horizon, *, error=1e-3, **options) -> MHE:
    model, observer, c = unstable()
    cost = DiscountedCost(P=2 * c.P_upper, Q=2 * c.Q, R=c.R, eta=0.5, prior_eta=1.0)
    known = Guarantee(c, disturbance=0.0, error=error)
    options = {"prior": Suboptimal(observer), "max_iterations": 0, "compile": "off", "guarantee": known} | options
    return MHE(model, horizon=horizon, cost=cost, **options)


def held(estimate, error, P) -> bool:
    """Whether an estimate has no level, or its error (nx,) is below."""
    level = estimate.bound.level
    return level is None or float(error @ P @ error) <= level * (1 + 1e-9)


@pytest.mark.parametrize("filtering", [False, True])
def test_the_cost_of_a_filtering_form_counts_its_newest_output_once_more(filtering):
    """(4.41) takes J over eta there: the exact guess of a plant at rest, doubling at every step, stays below."""
    mhe, P, known = suboptimal(10.0, filtering=filtering), unstable()[2].P_upper, 0
    state = mhe.init(x=[1e-3])
    for k in range(11):
        state, estimate = mhe.estimate(state, float(k))
        assert held(estimate, estimate.x, P)
        known += estimate.bound.level is not None
        state = mhe.observe(state, Measurement(float(k), [0.0]))
    assert known >= 8


def test_records_that_differ_by_round_off_are_one_step():
    """A message sent twice with the clock's round-off does not stand in for one that was lost."""
    mhe, P = suboptimal(4.0), unstable()[2].P_upper
    state = mhe.init(x=[1e-3])
    for k in range(12):
        state, estimate = mhe.estimate(state, float(k))
        assert held(estimate, estimate.x, P)
        if k != 5:
            state = mhe.observe(state, Measurement(float(k), [0.0]))
        if k == 4:
            state = mhe.observe(state, Measurement(float(np.nextafter(4.0, 5.0)), [0.0]))
    times = state.measurements.arrays()[0]
    assert (times == np.round(times)).all()


@pytest.mark.parametrize("which", ["parameter", "other model"])
def test_an_observer_of_other_dynamics_bounds_nothing(which):
    """Its certificate is about its own functions and parameters, whatever the signals are called."""

    def model(fixed=None):
        return DiscreteModel(
            lambda t, x, u, w, p: [0.3 * x[0] + 0.1 * x[1] + w[0], (p[0] if fixed is None else fixed) * x[1] + w[1]],
            lambda t, x, u, w, p: [x[0] + w[2]], step=1.0, x=["a", "b"], w=["d", "e", "v"], y=["y"],
            **({"p": ["p"], "p_start": [0.2]} if fixed is None else {}),
        )  # fmt: skip

    if which == "parameter":
        ours = model()
        observer = design_observer(ours, Bounds(x=BOX.x, w=BOX.w, p=(0.1, 0.3)), eta=0.35)
        domain, given = Bounds(x=BOX.x, w=BOX.w, p=(0.1, 0.97)), {"p": [0.97]}
    else:
        ours, observer, domain, given = model(0.95), design_observer(model(0.2), BOX, eta=0.35), BOX, {}
    c = certify_detectability(ours, domain, eta=0.96, Q=[10.0] * 3, R=10.0)
    cost = DiscountedCost(P=2 * c.P_upper, Q=2 * c.Q, R=c.R, eta=0.96, prior_eta=1.0)
    known = Guarantee(c, disturbance=0.0, error=5.0)
    options = {"max_iterations": 0, "compile": "off", "guarantee": known, "bounds": BOX}
    mhe = MHE(ours, horizon=3.0, cost=cost, prior=Suboptimal(observer), **options)
    state = mhe.init(x=[0.0, 5.0], **given)
    for k in range(20):
        state, estimate = mhe.estimate(state, float(k))
        assert held(estimate, estimate.x, c.P_upper)
        state = mhe.observe(state, Measurement(float(k), [0.0]))
    assert any("observer" in reason for reason in estimate.bound.reasons)


def test_a_larger_stated_error_starts_the_bounds_anew(tmp_path):
    """What rested on a guess stated to be good says nothing once it is stated to be poor."""
    first, second, P = suboptimal(3.0), suboptimal(3.0, error=1.0), unstable()[2].P_upper
    state = first.init(x=[1.0])  # wrong by one, which the second knows
    state, _ = first.estimate(first.observe(state, Measurement(0.0, [0.0])), 1.0)
    first.save(state, tmp_path / "state.npz")
    state = second.load(tmp_path / "state.npz")
    for k in range(1, 6):
        state, estimate = second.estimate(second.observe(state, Measurement(float(k), [0.0])), k + 1.0)
        assert held(estimate, estimate.x, P)


@cache
def joint(alpha=1e-3):
    """x+ = a x + p u: a parameter that the input excites."""
    model = DiscreteModel(
        lambda t, x, u, w, p: [0.5 * x[0] + p[0] * u[0] + w[0]], lambda t, x, u, w, p: [x[0] + w[1]],
        step=1.0, x=["a"], u=["f"], w=["d", "v"], p=["k"], y=["y"], p_start=[0.7],
        bounds=Bounds(x=(-5.0, 5.0), p=(0.5, 2.5), w=(-1.0, 1.0)),
    )  # fmt: skip
    domain = Bounds(x=(-5.0, 5.0), p=(0.5, 2.5), w=(-1.0, 1.0))
    states = detect_states(model, domain, eta=0.7, u=(-1.0, 1.0))
    design = design_excitation(model, domain, mu=0.7, u=(-1.0, 1.0))
    excited = design.excited_set(alpha)
    weights = joint_weights(states, excited, eta_1=0.9, eta_2=0.95)
    known = JointGuarantee(states=states, excited=excited, weights=weights, disturbance=[1e-4, 1e-4], error={"a": 1e-4})
    prior = ExcitedPrior(ExcitationMonitor(design), alpha, guarantee=known)
    return MHE(model, horizon=6.0, cost=weights.cost(model), bounds=domain, prior=prior, compile="off"), states


def run_joint(first: MHE, second: MHE, tmp_path, *, correct=None):
    """Six excited steps, then none; another configuration from step 8 on; p is 1.5. Radii and errors of p."""
    x, p, rng, found = 0.3, 1.5, np.random.default_rng(0), []
    state = first.control(first.init(x=[0.3], p=[0.7]), Input(0.0, [1.0]))
    state, mhe = first.control(state, Input(6.0, [0.0])), first
    for k in range(24):
        w = np.sign(rng.uniform(-1, 1, 2)) * 1e-4
        state = mhe.observe(state, Measurement(float(k), [x + w[1]]))
        x = 0.5 * x + p * (1.0 if k < 6 else 0.0) + w[0]
        state, estimate = mhe.estimate(state, k + 1.0)
        radii = None if estimate.bound is None else estimate.bound.radii
        found.append((k + 1, None if radii is None else radii[-1], abs(estimate.p[0] - p)))
        if k + 1 == 8 and second is not first:
            first.save(state, tmp_path / "joint.npz")
            state, mhe = second.load(tmp_path / "joint.npz"), second
        if k + 1 == 5 and correct is not None:
            state = correct(mhe, state)
    return found


def test_another_excited_set_starts_the_bounds_of_parameters_anew(tmp_path):
    """Levels of |dp|_S mean something else under another alpha: radii still hold the error."""
    first, second = joint()[0], joint(1e3)[0]
    for _, radius, error in run_joint(first, second, tmp_path):
        assert radius is None or error <= radius * (1 + 1e-9)


def test_doubtful_data_cost_the_bounds_that_rest_on_them(tmp_path):
    """A doubt about the excited steps is remembered: what was concluded from them is the domain's width again."""
    mhe = joint()[0]
    before = run_joint(mhe, mhe, tmp_path)
    after = run_joint(mhe, mhe, tmp_path, correct=lambda one, state: one.doubt(state, 1.0, "not to be trusted"))
    assert before[3][1] == after[3][1]  # known by then
    assert all(radius is None or error <= radius * (1 + 1e-9) for _, radius, error in before + after)
    memory = []

    def keep(one, state):
        changed = one.doubt(state, 1.0, "not to be trusted")
        memory.extend((state.memory["parameters"].arrays()[1], changed.memory["parameters"].arrays()[1]))
        return changed

    run_joint(mhe, mhe, tmp_path, correct=keep)
    assert np.isfinite(memory[0][-1, -7:]).all() and np.isnan(memory[1][-1, -7:]).all()


def test_the_weights_of_states_are_no_less_than_zero():
    """Lemmas add |w|_Q of truth and estimate: Q and S of Assumption 5.1 are positive semidefinite."""
    states = joint()[1]
    for matrix in (states.Q, states.S, states.R):
        assert np.linalg.eigvalsh(matrix)[0] >= -1e-9
