"""Laws of the priors that heed excitation: thesis (5.17), (5.80), Remark 5.2, and updates by direction."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe import MHE, RK4, Bounds, DiscountedCost, InputError, Measurement
from ctmhe.certificates import ExcitationMonitor, design_excitation, detect_states, joint_weights
from ctmhe.estimators.priors.joint import ExcitedPrior
from ctmhe.models import DiscreteModel
from ctmhe.models.library import chua, chua_discrete
from ctmhe.models.varying import varying_parameters
from ctmhe.types import Input
from tests.certificates.trajectories import mixer

NEVER, ALWAYS = 1e12, 1e-300
STEPS = 30


@cache
def monitor(name: str) -> ExcitationMonitor:
    """Monitors of Chua's circuit in both times, and of a model with two parameters."""
    if name == "mixer":
        return ExcitationMonitor(design_excitation(mixer(), u=(-1, 1), mu=0.9))
    model = chua() if name == "chua" else chua_discrete()
    return ExcitationMonitor(design_excitation(model, mu=0.1 if name == "chua" else 0.747))


def estimator(prior, model=None, horizon=0.1, **options) -> MHE:
    """An estimator of the circuit's states and p."""
    model = model or chua_discrete()
    P = np.diag([1.0, 1.0, 1.0, 10.0])
    defaults = {"cost": DiscountedCost(P=P, Q=1e4, R=1e2, eta=0.95), "bounds": model.bounds, "compile": "off"}
    return MHE(model, horizon=horizon, prior=prior, **defaults | options)


def swing(steps: int, seed: int = 0, x=(1.0, 0.0, -1.0)) -> np.ndarray:
    """Measured voltages of the circuit, with noise."""
    model, rng, y = chua_discrete(), np.random.default_rng(seed), []
    for _ in range(steps):
        y.append(x[0] + rng.uniform(-0.01, 0.01))
        x = np.asarray(model.dynamics(0.0, x, [], np.zeros(4), [0.45])).ravel()
    return np.array(y)


def run(mhe: MHE, y: np.ndarray, state=None, first: int = 0):
    """One estimate a step, in the prediction form."""
    n, h, kept = len(mhe.model.x), 0.01, []
    guess = np.array([0.8, 0.1, -0.8, 0.3])
    state = state or mhe.init(x=guess[:n], p=guess[n:])
    for k, value in enumerate(y, first):
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(k * h, [value])), (k + 1) * h)
        kept.append(estimate)
    return state, kept


def told(kept) -> np.ndarray:
    """States and parameters that a run's estimates tell."""
    return np.array([np.concatenate([estimate.x, estimate.p]) for estimate in kept])


def test_with_everything_excited_it_is_the_filtering_prior():
    """alpha_t >= alpha in all windows: p_bar(t) = p*(t) for t >= N, so that from 2 N on both are one, bit for bit."""
    y, prior = swing(STEPS), ExcitedPrior(monitor("step"), ALWAYS)
    state, first = run(estimator(prior), y[:20])
    assert all(estimate.prior[3] == 0.3 for estimate in first[:19]) and first[-1].prior[3] == first[9].p[0]
    plain, excited = (run(estimator(one), y[20:], state, 20)[1] for one in ("filtering", prior))
    np.testing.assert_array_equal(told(excited), told(plain))
    assert excited[-1].status.notes == ()


@pytest.mark.parametrize("directions", [False, True])
def test_with_nothing_excited_the_parameters_prior_is_the_initial_one(directions):
    """alpha_t < alpha always: every window has p_bar = xi, the estimate tells xi, and names p."""
    prior = ExcitedPrior(monitor("step"), NEVER, directions=directions)
    kept = run(estimator(prior), swing(STEPS))[1]
    assert all(estimate.prior[3] == 0.3 and estimate.p[0] == 0.3 for estimate in kept)
    assert any(estimate.trajectory.p[0] != 0.3 for estimate in kept)
    assert "never excited" in kept[-1].status.notes[0] and kept[-1].status.notes[0].endswith("p")
    assert kept[-1].status.success and abs(kept[-1].x[0] - swing(STEPS + 1)[-1]) < 0.2


def test_the_prior_of_a_window_is_that_of_the_window_that_ended_there():
    """(5.17): p*(t - N) if that window was excited and full, else the prior which it had itself."""
    y = swing(60)
    all_levels = [monitor("step").level(e.trajectory) for e in run(estimator("filtering"), y)[1]]
    alpha = float(np.median(all_levels[12:]))
    kept, N = run(estimator(ExcitedPrior(monitor("step"), alpha)), y)[1], 10
    renewed = []
    for t in range(N + 1, len(kept)):  # kept[t - 1] ends at t
        before, now = kept[t - N - 1], kept[t - 1]
        excited = monitor("step").level(before.trajectory) >= alpha and t - N >= N
        renewed.append(excited)
        expected = before.trajectory.p[0] if excited else before.prior[3]
        assert now.prior[3] == pytest.approx(expected, abs=1e-15)
        np.testing.assert_allclose(now.prior[:3], before.x, rtol=1e-9)
    assert any(renewed) and not all(renewed)


def test_the_estimate_tells_the_parameters_of_the_last_excited_window():
    """Remark 5.2."""
    y = swing(60)
    levels = [monitor("step").level(e.trajectory) for e in run(estimator("filtering"), y)[1]]
    alpha, last = float(np.median(levels)), 0.3
    for estimate in run(estimator(ExcitedPrior(monitor("step"), alpha)), y)[1]:
        if monitor("step").level(estimate.trajectory) >= alpha:
            last = estimate.trajectory.p[0]
        assert estimate.p[0] == last


def test_with_the_parameters_known_it_is_plain_estimation():
    """A prior weight on p beyond any doubt gives the states of an estimator that is told p."""
    model, y = chua_discrete(), swing(STEPS)
    known = MHE(
        model, horizon=0.1, cost=DiscountedCost(P=1.0, Q=1e4, R=1e2, eta=0.95), bounds=model.bounds, compile="off"
    )
    cost = DiscountedCost(P=np.diag([1.0, 1.0, 1.0, 1e14]), Q=1e4, R=1e2, eta=0.95)
    for prior in (ExcitedPrior(monitor("step"), NEVER), ExcitedPrior(monitor("step"), ALWAYS)):
        joint = estimator(prior, cost=cost)
        start = {"x": [0.8, 0.1, -0.8], "p": [0.45]}
        a, b = run(known, y, known.init(**start))[1], run(joint, y, joint.init(**start))[1]
        np.testing.assert_allclose(told(b), told(a), atol=1e-5)


@settings(max_examples=8)
@given(cut=st.integers(1, STEPS - 1), alpha=st.sampled_from([ALWAYS, 1e-9, 1e-7, NEVER]))
def test_a_saved_state_goes_on_bit_for_bit(tmp_path_factory, cut, alpha):
    """The memory is in the state."""
    mhe, y, path = estimator(ExcitedPrior(monitor("step"), alpha)), swing(STEPS), tmp_path_factory.mktemp("s") / "s.npz"
    whole = run(mhe, y)[1]
    state, first = run(mhe, y[:cut])
    mhe.save(state, path)
    rest = run(mhe, y[cut:], mhe.load(path), cut)[1]
    np.testing.assert_array_equal(told([*first, *rest]), told(whole))


def test_a_solve_repeated_takes_its_own_place_and_the_memory_stays_small():
    """Estimating twice at one time changes nothing; what is remembered spans one horizon."""
    mhe, y = estimator(ExcitedPrior(monitor("step"), 1e-7)), swing(40)
    state, kept = run(mhe, y)
    again, estimate = mhe.estimate(state, state.t)
    np.testing.assert_allclose(told([estimate]), told(kept[-1:]), rtol=1e-5)
    assert len(again.memory["parameters"]) == len(state.memory["parameters"]) <= 12


def mixed(prior, u, seed=0, steps=60):
    """The model with two parameters, of which `feed` enters with the state and `gain` with the input."""
    model, rng = mixer(), np.random.default_rng(seed)
    mhe = MHE(
        model, horizon=20.0, cost=DiscountedCost(P=np.diag([1.0, 1.0, 1.0, 1.0]), Q=1e3, R=1e2, eta=0.98),
        bounds=model.bounds, prior=prior, compile="off",
    )  # fmt: skip
    x, p, kept = np.array([0.3, 0.1]), [1.2, -0.1], []
    state = mhe.init(x=x, p=[0.8, 0.05])
    for k in range(steps):
        drive = u(k)
        w = rng.uniform(-1, 1, 3) * [1e-3, 1e-3, 1e-2]
        state = mhe.control(state, Input(float(k), [drive]))
        state = mhe.observe(state, Measurement(float(k), [x[0] + w[2]]))
        state, estimate = mhe.estimate(state, k + 1.0)
        x = np.asarray(model.dynamics(0.0, x, [drive], w, p)).ravel()
        kept.append(estimate)
    return state, kept


def test_directions_with_everything_excited_are_the_full_update():
    """The projection on all combinations is the identity; the first windows, of few steps, excite one only."""
    prior = [ExcitedPrior(monitor("mixer"), 1e-9, directions=choice) for choice in (False, True)]
    a, b = (told(mixed(one, np.sin)[1]) for one in prior)
    np.testing.assert_allclose(a[5:], b[5:], atol=1e-6)


def test_directions_move_what_is_excited_and_keep_the_rest():
    """Between the two levels of the information, its excited eigenvector moves by what the window found; the other
    combination keeps its value, in parameters over their nominals, from window to window."""
    watch = monitor("mixer")
    _, plain = mixed("filtering", np.sin)
    found = watch.along(plain[-1].trajectory)
    alpha = float(np.sqrt(found.directions[0].level * found.directions[1].level))
    _, kept = mixed(ExcitedPrior(watch, alpha, directions=True), np.sin)
    _, whole = mixed(ExcitedPrior(watch, alpha), np.sin)
    assert whole[-1].p[0] == 0.8 and whole[-1].p[1] == 0.05  # all or nothing: nothing
    nominal, moved = found.nominal, 0
    for before, now in pairwise(kept):
        basis = watch.along(now.trajectory).excited(alpha)
        change, offered = (now.p - before.p) / nominal, (now.trajectory.p - before.p) / nominal
        np.testing.assert_allclose(change, basis @ (basis.T @ offered), atol=1e-9)
        moved += basis.shape[1] == 1
    assert moved > 20


def test_a_parameter_that_is_never_excited_is_named():
    """Without input, the input's gain shows nowhere; the estimate stays usable and the note names `gain` only."""
    _, kept = mixed(ExcitedPrior(monitor("mixer"), 1e-4, directions=True), lambda k: 0.0)
    notes = [note for note in kept[-1].status.notes if note.startswith("never excited")]
    assert notes and "gain" in notes[0]
    assert kept[-1].p[0] == pytest.approx(0.8, abs=1e-9) and kept[-1].status.success


def varying(prior, **options) -> MHE:
    """The circuit with p as a fourth state."""
    world = varying_parameters(chua_discrete(), drift=1e-4)
    cost = DiscountedCost(P=2.0, Q=np.diag([1e4, 1e4, 1e4, 1e2, 1e6]), R=1e2, eta=1.0, prior_eta=0.9)
    return MHE(world, horizon=0.1, prior=prior, **{"cost": cost, "bounds": world.bounds, "compile": "off"} | options)


def test_parameters_that_vary_have_the_same_laws():
    """(5.80): all excited is the filtering prior; none keeps g^(N)(p_bar), here p_bar, and states are not touched."""
    y, always = swing(STEPS), ExcitedPrior(monitor("step"), ALWAYS)
    state, _ = run(varying(always), y[:20])
    excited, plain = (told(run(varying(one), y[20:], state, 20)[1]) for one in (always, "filtering"))
    np.testing.assert_array_equal(excited, plain)
    never = run(varying(ExcitedPrior(monitor("step"), NEVER)), y)[1]
    assert all(estimate.prior[3] == 0.3 and estimate.x[3] == 0.3 for estimate in never)
    for t in range(11, len(never)):
        np.testing.assert_allclose(never[t - 1].prior[:3], never[t - 11].x[:3], rtol=1e-9)


def test_what_is_kept_is_carried_along_g():
    """With p+ = 0.9 p, a prior that is never renewed is 0.9^t times the initial one."""
    world = varying_parameters(chua_discrete(), lambda p, u, w: 0.9 * p)
    cost = DiscountedCost(P=2.0, Q=1e4, R=1e2, eta=1.0, prior_eta=0.9)
    bounds = Bounds(w=world.bounds.w)
    mhe = MHE(world, horizon=0.1, prior=ExcitedPrior(monitor("step"), NEVER), cost=cost, bounds=bounds, compile="off")
    kept = run(mhe, swing(25))[1]
    for t, estimate in enumerate(kept, 1):
        assert estimate.x[3] == pytest.approx(0.3 * 0.9**t, rel=1e-9)
        assert estimate.prior[3] == pytest.approx(0.3 * 0.9 ** max(t - 10, 0), rel=1e-9)


def test_in_continuous_time_irregular_samples_and_gaps_keep_the_rules():
    """Windows start between solves: the prior of p is that of the solve whose piece is there; a gap changes nothing."""
    model = chua()
    options = {
        "model": model, "horizon": 0.3, "interval": 0.05, "integrator": RK4(0.01), "hold": "point",
        "cost": DiscountedCost(P=np.diag([1.0, 1.0, 1.0, 10.0]), Q=1e2, R=1e2, rate=1.0), "bounds": model.bounds,
    }  # fmt: skip
    times = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.08, 25))
    times = np.append(times, times[-1] + 0.5)  # a gap longer than the horizon
    y = swing(250)[np.round(times / 0.01).astype(int)]
    plain = estimator("filtering", **options)
    for alpha in (ALWAYS, NEVER):
        mhe = estimator(ExcitedPrior(monitor("chua"), alpha), **options)
        state = mhe.init(x=[0.8, 0.1, -0.8], p=[0.3])
        for t, value in zip(times, y, strict=True):
            known = mhe.observe(state, Measurement(float(t), [value]))
            state, found = mhe.estimate(known, float(t))
            if alpha == NEVER:
                assert found.prior[3] == 0.3 and found.p[0] == 0.3
            elif t > 0.7:  # windows that start after full ones
                np.testing.assert_array_equal(found.prior, plain.estimate(known, float(t))[1].prior)
        assert "prior predicted, uncertified" in found.status.notes and found.status.success


def test_the_cost_of_joint_weights_fades_as_5_9_says():
    """gamma(N_t) on states, eta_1^N_t on parameters, eta_2 on the stage, in a growing window and a full one."""
    model = chua_discrete()
    states, excited = detect_states(model, eta=0.91), monitor("step").design.excited_set(2e-4)
    weights = joint_weights(states, excited, eta_1=0.934, eta_2=0.9997)
    mhe = MHE(model, horizon=0.1, cost=weights.cost(model, V=lambda t: (1 + t) * weights.V), compile="off")
    state, y = mhe.init(x=[0.8, 0.1, -0.8], p=[0.3]), swing(20)
    for k, value in enumerate(y):
        state, e = mhe.estimate(mhe.observe(state, Measurement(k * 0.01, [value])), (k + 1) * 0.01)
        n, run_ = min(k + 1, 10), e.trajectory
        dx, dp = run_.x[0] - e.prior[:3], run_.p - e.prior[3:]
        fade = weights.eta_2 ** np.arange(n - 1.0, -1.0, -1.0)
        dy = run_.y[:, 0] - y[k + 1 - n : k + 1]
        V = (1 + max(k + 1 - 10, 0) * 0.01) * weights.V
        J = weights.gamma(n) * dx @ weights.W @ dx + weights.eta_1**n * dp @ V @ dp
        J += fade @ (np.einsum("ki,ij,kj->k", run_.w, weights.Q, run_.w) + weights.R[0, 0] * dy**2)
        assert e.cost == pytest.approx(J, rel=1e-6)
    with pytest.raises(InputError, match="weights are W, V, Q and R, got S"):
        weights.cost(model, S=1.0)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: ExcitedPrior(monitor("step"), 0.0), "alpha must be a positive number"),
        (lambda: ExcitedPrior("filtering", 1.0), r"ExcitationMonitor\(design_excitation"),
        (lambda: ExcitedPrior(monitor("step"), 1.0, guarantee=1.0), "JointGuarantee"),
        (lambda: estimator(ExcitedPrior(monitor("mixer"), 1.0)).init(x=[0, 0, 0]), "counts steps of"),
        (lambda: stranger(x=("a", "x2", "x3")), "no state x1"),
        (lambda: stranger(p=("q",)), "p is neither a parameter nor a state"),
        (
            lambda: estimator(ExcitedPrior(monitor("step"), 1.0), cost=DiscountedCost(P=1.0)).init(x=[0, 0, 0]),
            "takes p for known",
        ),
    ],
)
def test_what_does_not_fit_is_named(make, text):
    """Errors name the signal and what to do."""
    with pytest.raises(InputError, match=text):
        make()


def stranger(x=("x1", "x2", "x3"), p=("p",)):
    """An estimator of a model with other names than the monitor's."""
    own = chua_discrete()
    model = DiscreteModel(
        own.dynamics, lambda t, x, u, w, p: x[0] + w[3],
        step=0.01, x=x, w=own.w.names, p=p, y="voltage",
    )  # fmt: skip
    P = np.eye(4)
    return MHE(model, horizon=0.1, cost=DiscountedCost(P=P), prior=ExcitedPrior(monitor("step"), 1.0)).init(x=[0, 0, 0])
