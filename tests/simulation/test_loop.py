"""Laws of the loop: when samples happen, what is known when, and that nothing depends on what it should not."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError, TriggerError
from ctmhe.estimators import MHE
from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.simulation import (
    Everything,
    Gaussian,
    OdePlant,
    Recorded,
    SingleSample,
    Uniform,
    WholeSignal,
    simulate,
)
from ctmhe.simulation.follower import Follower
from ctmhe.transcription.integrators import RK4
from ctmhe.triggers import (
    Innovation,
    MaxInterval,
    MinInterval,
    Periodic,
    Scheduled,
    SendOnDelta,
    Trigger,
    trigger,
)
from ctmhe.types import DiscountedCost, Input

DECAY = ContinuousModel(
    lambda t, x, u, w, p: -x + w[0],
    lambda t, x, u, w, p: x + w[1],
    x="level",
    y="gauge",
    w=("d", "v"),
    units={"level": "m", "gauge": "m", "v": "m"},
    name="decay",
)
COST = DiscountedCost(eta=0.5, P=1.0, Q=[10.0, 10.0], R=100.0)
NEVER = Scheduled([1e9])
BASE = {"until": 1.0, "guess": [0.5], "truth": [1.0], "monitor": 0.05}


@pytest.fixture(scope="module")
def mhe():
    return MHE(DECAY, horizon=1.0, interval=0.1, integrator=RK4(step=0.05), cost=COST)


@pytest.fixture(scope="module")
def sampled_mhe():
    return MHE(DECAY, horizon=1.0, interval=0.1, integrator=RK4(step=0.05), cost=COST, hold="point")


def run(mhe, policy, **changes):
    return simulate(DECAY, mhe, trigger=policy, **{**BASE, **changes})


class Level(Trigger):
    """Fires when the output falls to `at`; a guard of the user's own."""

    def __init__(self, at):
        self.at = at

    def guard(self, ctx):
        return self.at - ctx.y[0]


def test_zero_threshold_equals_sampling_at_every_monitoring_time(mhe):
    """Send-on-delta with delta = 0 is periodic sampling with the monitoring step: same samples, same estimates."""
    noise = {"v": Uniform(0.01, interval=0.05)}
    zero, every = run(mhe, SendOnDelta(0.0), disturbance=noise), run(mhe, Periodic(0.05), disturbance=noise)
    np.testing.assert_allclose(zero.sample_times, every.sample_times, atol=1e-12)
    np.testing.assert_allclose(zero.sample_times, 0.05 * np.arange(21), atol=1e-12)
    np.testing.assert_allclose(zero.dataset["x_online"], every.dataset["x_online"], atol=1e-9)


def test_infinite_threshold_equals_open_loop_prediction(mhe):
    """Without samples, both estimates are the model's solution from the guess."""
    silent = run(mhe, SendOnDelta(np.inf) | Innovation(np.inf))
    assert silent.samples == 0
    for variable in ("x_online", "x_retro"):
        np.testing.assert_allclose(
            silent.dataset[variable][:, 0], 0.5 * np.exp(-silent.t), rtol=1e-7
        )  # RK4 with 0.05: its error is h^4 / 120


@pytest.mark.parametrize("backend", ["scikits.odes", "casadi"])
def test_a_level_crossing_is_located_to_1e_8(mhe, backend):
    """y = exp(-t) loses 0.1 at t_k = -ln(1 - 0.1 k), whatever the monitoring step."""
    if backend == "scikits.odes":
        pytest.importorskip("scikits_odes_sundials")
    plant = OdePlant(DECAY, backend=backend)
    crossings = simulate(plant, mhe, trigger=SendOnDelta(0.1), **BASE)
    expected = -np.log(1 - 0.1 * np.arange(len(crossings.sample_times)))
    assert len(expected) == 7
    np.testing.assert_allclose(crossings.sample_times, expected, atol=1e-8)


def test_the_guard_is_reached_at_the_located_time(mhe):
    """At the sample the level is >= 0 to the bit, so that a recorded event fires again when it is replayed."""
    crossings = run(mhe, SendOnDelta(0.1))
    y = crossings.dataset["y_sampled"].to_numpy()[:, 0]
    assert (np.abs(np.diff(y)) >= 0.1).all()


def test_a_jump_across_zero_fires_at_the_jump(mhe):
    """A noise value that holds from t = 0.13 on, between monitoring times, is seen at 0.13."""
    noise = {"v": Recorded([0.0, 0.13, 0.14], [0.0, -5.0, 0.0])}
    jumps = run(mhe, Level(-1.0), disturbance=noise)
    np.testing.assert_allclose(jumps.sample_times, [0.13], atol=1e-12)


def test_a_guard_is_located_under_a_prediction_that_moves(mhe):
    """Innovation: |exp(-t) - 0.5 exp(-t)| falls to 0.4 at t = ln(5/4), seen from above."""

    class Agrees(Trigger):
        def guard(self, ctx):
            return 0.4 - abs(ctx.y[0] - ctx.y_hat[0]) if ctx.samples == 0 else -1.0

    found = run(mhe, Agrees())
    np.testing.assert_allclose(found.sample_times, [np.log(1.25)], atol=1e-6)  # RK4's own error


@given(st.floats(0.021, 0.5), st.floats(0.021, 0.5))
@settings(max_examples=8, deadline=None)
def test_or_is_the_earliest_and_and_the_latest_of_two_self_triggered(mhe, a, b):
    """MaxInterval(a) | MaxInterval(b) waits min(a, b), & waits max(a, b), at exact times."""
    either, both = run(mhe, MaxInterval(a) | MaxInterval(b)), run(mhe, MaxInterval(a) & MaxInterval(b))
    np.testing.assert_allclose(either.gaps, min(a, b), atol=1e-9)
    np.testing.assert_allclose(both.gaps, max(a, b), atol=1e-9)


@given(st.floats(0.003, 0.3), st.floats(0.001, 0.5), st.floats(0.0, 0.2))
@settings(max_examples=12, deadline=None)
def test_min_and_max_interval_bound_every_gap(mhe, shortest, extra, delta):
    """dead time <= t_i - t_(i-1) <= longest wait, for any guard underneath."""
    longest = shortest + extra
    policy = (SendOnDelta(delta) | MaxInterval(longest)) & MinInterval(shortest)
    noise = {"v": Uniform(0.1, interval=0.013)}
    gaps = run(mhe, policy, disturbance=noise, until=0.6).gaps[1:]
    assert (gaps >= shortest - 2e-9).all()
    assert (gaps <= longest + 2e-9).all()


def test_dead_time_ends_in_a_sample_when_the_guard_is_up(mhe):
    """policy & MinInterval fires at the first time the guard is >= 0 and the dead time is over, not a grid later."""
    held = run(mhe, SendOnDelta(0.0) & MinInterval(0.0731))
    np.testing.assert_allclose(held.gaps[1:], 0.0731, atol=1e-9)


def test_a_yes_is_asked_for_at_monitoring_times_and_stands_until_the_next(mhe):
    """A predicate fires on the monitoring grid; under a dead time it fires when that is over."""

    @trigger
    def low(ctx):
        return ctx.y[0] < 0.9

    assert run(mhe, low).sample_times[0] == pytest.approx(0.15, abs=1e-12)  # exp(-0.15) < 0.9 < exp(-0.1)
    dead = run(mhe, low & MinInterval(0.08)).sample_times
    np.testing.assert_allclose(dead[:3], [0.15, 0.23, 0.31], atol=1e-9)


def test_mixed_policies_keep_exact_times_and_locations(mhe):
    """Predicate, guard and self-triggered policy under one `|`: each at its own exact time."""

    @trigger
    def at_half(ctx):
        return abs(ctx.t - 0.5) < 1e-9

    mixed = run(mhe, at_half | (Level(0.8) & MinInterval(10.0)) | Scheduled([0.3333]))
    np.testing.assert_allclose(mixed.sample_times, [-np.log(0.8), 0.3333, 0.5], atol=1e-8)


def test_guard_and_predicate_fire_at_the_exact_crossing(mhe):
    """A predicate's yes stands while the guard is located."""
    both = run(mhe, Level(0.8) & trigger(lambda ctx: ctx.samples == 0))
    np.testing.assert_allclose(both.sample_times, [-np.log(0.8)], atol=1e-8)


def test_same_seed_same_run_other_seed_other_run(mhe):
    """Everything but wall-clock times is equal to the bit."""
    policy, noise = SendOnDelta(0.05) | MaxInterval(0.3), {"d": Gaussian(0.1), "v": Uniform(0.02)}
    first, second, other = (run(mhe, policy, disturbance=noise, seed=seed) for seed in (3, 3, 4))
    assert first.dataset.drop_vars("solve_seconds").identical(second.dataset.drop_vars("solve_seconds"))
    assert not np.array_equal(first.dataset["x_true"], other.dataset["x_true"])
    generators = [run(mhe, policy, disturbance=noise, seed=np.random.default_rng(5)) for _ in range(2)]
    assert np.array_equal(generators[0].dataset["y"], generators[1].dataset["y"])


def test_the_truth_does_not_depend_on_the_policy(mhe):
    """Two policies meet the same disturbance to the bit, and the same trajectory to the plant's tolerance."""
    noise = {"d": Gaussian(0.1, interval=0.02), "v": Uniform(0.02, interval=0.02)}
    often, rarely = (run(mhe, policy, disturbance=noise) for policy in (SendOnDelta(0.01), Periodic(0.31)))
    assert np.array_equal(often.dataset["w"], rarely.dataset["w"])
    np.testing.assert_allclose(often.dataset["x_true"], rarely.dataset["x_true"], rtol=1e-8)


def test_online_is_what_was_known_and_retrospective_the_estimated_trajectory(mhe):
    """At a sample the two meet at x_hat; before it, online is the prediction from the sample before."""
    result = run(mhe, Scheduled([0.2, 0.6]), disturbance={"v": Uniform(0.05, interval=0.05)})
    online, retro = (result.dataset[name].to_numpy()[:, 0] for name in ("x_online", "x_retro"))
    x_hat, t = result.dataset["x_hat"].to_numpy()[:, 0], result.t
    assert online[0] == retro[0] == 0.5
    for k, i in ((4, 0), (12, 1)):
        assert online[k] == x_hat[i]
        assert retro[k] == pytest.approx(x_hat[i], rel=1e-9)
    np.testing.assert_allclose(online[4:12], x_hat[0] * np.exp(-(t[4:12] - 0.2)), rtol=1e-6)
    np.testing.assert_allclose(online[:4], 0.5 * np.exp(-t[:4]), rtol=1e-6)
    np.testing.assert_array_equal(retro[13:], online[13:])
    assert abs(retro[4] - online[3]) > 1e-3
    assert result.retrospective_rms() < result.online_rms()


def test_channels_deliver_what_they_say(mhe, sampled_mhe):
    """Whole signal: all records up to the event; everything: all records at once; single sample: one an event."""
    policy = Scheduled([0.2, 0.52])
    whole = run(mhe, policy)
    assert list(whole.dataset["delivered"]) == [5, 7]  # 0 ... 0.2, then 0.25 ... 0.5 and the event itself
    assert run(mhe, policy, channel=WholeSignal(every=0.1)).measurements == 3 + 4
    everything = run(mhe, policy, channel=Everything(every=0.1))
    assert (everything.measurements, everything.samples) == (11, 2)
    single = run(sampled_mhe, policy, channel=SingleSample())
    assert list(single.dataset["delivered"]) == [1, 1]


def test_samples_carry_the_output_at_their_own_time(sampled_mhe):
    """With a noiseless plant started at the guess, the estimate is the truth: cost zero but for RK4's error."""
    exact = run(sampled_mhe, Periodic(0.17), guess=[1.0], channel=SingleSample())
    assert exact.online_rms() < 1e-6
    assert (exact.dataset["cost"] < 1e-10).all()


def test_the_whole_signal_is_the_output_between_records_too():
    """An output that is linear in time, rebuilt linearly from its records, leaves a cost of zero."""
    model = ContinuousModel(lambda t, x, u, w, p: w[0] + 1, lambda t, x, u, w, p: x, x="s", y="z", w="d", name="cart")
    cost = DiscountedCost(P=1.0, Q=1.0, R=1.0)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(step=0.1), cost=cost, hold="linear")
    exact = simulate(model, mhe, trigger=Periodic(0.17), until=2.0, guess=[0.0], truth=[0.0], monitor=0.05)
    assert (exact.dataset["cost"] < 1e-12).all()


class TestRefusals:
    def test_a_channel_that_does_not_fit_the_hold(self, mhe, sampled_mhe):
        with pytest.raises(InputError, match=r"SingleSample.*'gauge' with hold='zero'"):
            run(mhe, NEVER, channel=SingleSample())
        with pytest.raises(InputError, match=r"WholeSignal.*'gauge' with hold='point'.*SingleSample"):
            run(sampled_mhe, NEVER)

    def test_a_declared_wait_not_shorter_than_the_horizon(self, mhe):
        """Thesis (3.19): T > delta_bar."""
        with pytest.raises(InputError, match=r"3\.19"):
            run(mhe, SendOnDelta(0.1) | MaxInterval(1.0))
        with pytest.raises(InputError, match=r"3\.19"):
            run(mhe, Periodic(1.5))

    def test_signals_that_do_not_match(self, mhe):
        other = ContinuousModel(lambda t, x, u, w, p: -x, lambda t, x, u, w, p: x, x="level", y="gage", name="other")
        with pytest.raises(InputError, match="'other' has no output 'gauge'"):
            simulate(other, mhe, trigger=NEVER, **BASE)
        with pytest.raises(InputError, match="unknown disturbance 'dd'"):
            run(mhe, NEVER, disturbance={"dd": Uniform(1.0)})
        with pytest.raises(InputError, match=r"truth.*level"):
            run(mhe, NEVER, truth=[1.0, 2.0])

    def test_spans_and_steps_that_make_no_sense(self, mhe):
        with pytest.raises(InputError, match="must come after"):
            run(mhe, NEVER, until=0.0)
        with pytest.raises(InputError, match="monitor"):
            run(mhe, NEVER, monitor=0.0)
        with pytest.raises(InputError, match="seed"):
            run(mhe, NEVER, seed=-1)

    def test_a_policy_that_fails_in_mid_run_names_itself(self, mhe):
        class Breaks(Trigger):
            def guard(self, ctx):
                return -1.0 if ctx.t < 0.32 else np.nan

        with pytest.raises(TriggerError, match=r"Breaks.*NaN at t = 0.35"):
            run(mhe, Breaks())

    def test_a_policy_that_does_not_advance(self, mhe):
        class Stands(Trigger):
            def next_time(self, ctx):
                return ctx.t

        with pytest.raises(TriggerError, match=r"Stands.*does not lie ahead"):
            run(mhe, Stands())

    def test_zeno_behaviour_ends_in_an_error_that_names_the_remedy(self, mhe):
        """A policy that names times ever so little ahead would fire infinitely often."""

        class Zeno(Trigger):
            def next_time(self, ctx):
                return ctx.t + 1e-8 if ctx.samples else ctx.t

        with pytest.raises(TriggerError, match=r"Zeno.*fires without end.*MinInterval"):
            run(mhe, Zeno())
        assert 5 < run(mhe, Zeno() & MinInterval(0.1)).samples <= 11


def test_inputs_reach_plant_and_estimator_alike():
    """dx/dt = u: held inputs and linear ones, from lists, functions and records, with the exact integral known."""
    model = ContinuousModel(
        lambda t, x, u, w, p: u, lambda t, x, u, w, p: x, x="s", u="speed", y="odometer", name="cart"
    )
    options = dict(horizon=1.0, interval=0.1, integrator=RK4(step=0.1), cost=DiscountedCost(P=1.0, R=1.0), hold="point")
    held, linear = MHE(model, **options), MHE(model, **options, input_hold="linear")
    policy, base = Scheduled([0.37]), {"until": 1.0, "guess": [0.0], "truth": [0.0], "monitor": 0.1}
    base["channel"] = SingleSample()
    switches = [Input(0.0, [1.0]), Input(0.25, [3.0])]
    ramp = Recorded([0.0, 0.5, 2.0], [0.0, 1.0, 4.0], hold="linear")
    cases = [
        (held, [2.0], lambda t: 2 * t),
        (held, switches, lambda t: t if t < 0.25 else 0.25 + 3 * (t - 0.25)),
        (held, lambda t: [10 * t], lambda t: 0.1 * sum(range(round(10 * t)))),
        (linear, ramp, lambda t: t**2),
    ]
    for mhe, inputs, exact in cases:
        result = simulate(model, mhe, trigger=policy, inputs=inputs, **base)
        truth = np.array([exact(t + 1e-12) for t in result.t])
        np.testing.assert_allclose(result.dataset["x_true"][:, 0], truth, atol=1e-8)
        np.testing.assert_allclose(result.dataset["x_hat"][:, 0], result.dataset["y_sampled"][:, 0], atol=1e-8)
        np.testing.assert_allclose(result.dataset["x_online"], result.dataset["x_true"], atol=0.02)
    with pytest.raises(InputError, match=r"inputs.*speed"):
        simulate(model, held, trigger=policy, **base)


def test_parameters_of_plant_and_estimator_are_told_apart():
    """p is the estimator's, p_true the plant's; both are in the run."""
    model = ContinuousModel(
        lambda t, x, u, w, p: -p[0] * x, lambda t, x, u, w, p: x, x="s", p="rate", y="z", p_start=[3.0]
    )
    cost = DiscountedCost(P=[1.0, 0.01], R=1e4)
    mhe = MHE(model, horizon=2.0, interval=0.1, integrator=RK4(step=0.02), cost=cost)
    result = simulate(model, mhe, trigger=Periodic(0.2), until=1.0, guess=[1.0], truth=[1.0], p=[1.0], p_true=[2.0])
    assert result.dataset["p_true"].to_numpy() == [2.0]
    assert result.dataset["p_hat"].to_numpy()[-1, 0] == pytest.approx(2.0, abs=1e-2)


def test_discrete_plants_advance_in_whole_steps():
    """A step map is applied once a step; times in between are refused with the step's length."""
    model = DiscreteModel(
        lambda t, x, u, w, p: 0.5 * x, lambda t, x, u, w, p: x, x="s", y="z", step=0.1, name="halving"
    )
    mhe = MHE(model, horizon=0.5, cost=DiscountedCost(P=1.0, R=1.0, eta=0.9))
    result = simulate(model, mhe, trigger=Periodic(0.2), until=1.0, guess=[1.0], truth=[2.0])
    np.testing.assert_allclose(result.dataset["x_true"][:, 0], 2.0 * 0.5 ** np.arange(11), rtol=1e-12)
    with pytest.raises(InputError, match=r"'halving' is discrete-time with step 0.1"):
        simulate(model, mhe, trigger=Periodic(0.25), until=1.0, guess=[1.0], truth=[2.0])


def test_a_run_begins_anywhere_on_the_time_axis(mhe):
    """Start and end need not be multiples of the monitoring step; negative times are times."""
    early = run(mhe, Periodic(0.25), start=-0.52, until=0.33)
    np.testing.assert_allclose(early.t[[0, 1, -2, -1]], [-0.52, -0.5, 0.3, 0.33], atol=1e-12)
    np.testing.assert_allclose(early.sample_times, [0.0, 0.25], atol=1e-12)
    np.testing.assert_allclose(early.dataset["x_true"][:, 0], np.exp(-(early.t + 0.52)), rtol=1e-8)


def test_a_gap_longer_than_the_horizon_keeps_the_prediction(mhe):
    """An undeclared wait may exceed the horizon: the trajectory before the window is the prediction."""
    gap = run(mhe, trigger(lambda ctx: min(abs(ctx.t - 0.1), abs(ctx.t - 2.6)) < 1e-9), until=3.0)
    retro, online = gap.dataset["x_retro"].to_numpy(), gap.dataset["x_online"].to_numpy()
    between = (gap.t > 0.12) & (gap.t < 1.55)
    np.testing.assert_array_equal(retro[between], online[between])
    assert "prior predicted, uncertified" in str(gap.dataset["status"].to_numpy()[1])


def test_casadi_operations_on_plants_match_numpy():
    """The plant's output is h at the true state, input and disturbance."""
    model = ContinuousModel(
        lambda t, x, u, w, p: [x[1], -x[0]], lambda t, x, u, w, p: ca.sin(x[0]) + w, x=("a", "b"), y="z", w="v"
    )
    plant = OdePlant(model)
    plant.start(0.0, np.array([1.0, 0.0]))
    plant.advance(0.5, np.zeros(0), np.zeros(0), np.array([0.25]))
    assert plant.output(np.zeros(0), np.array([0.25]))[0] == pytest.approx(np.sin(np.cos(0.5)) + 0.25, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(0.01, 0.97), min_size=1, max_size=8), st.floats(0.0, 0.3))
def test_a_predicted_covariance_does_not_depend_on_what_was_asked_before(times, since):
    """Carried on from cell to cell, or from the last estimate at once: the same, and so are state and output."""
    mhe = MHE(DECAY, horizon=1.0, interval=0.1, integrator=RK4(step=0.05), cost=COST, hold="point")
    start = mhe.init(t=since, x=[0.7])
    asked = Follower(mhe, start).forecast
    for t in [since + time for time in times]:
        at_once = Follower(mhe, start).forecast
        assert asked.covariance(t) == pytest.approx(at_once.covariance(t), rel=1e-7)  # edges within 1e-9 are one
        assert (asked.state(t) == at_once.state(t)).all()
        assert asked.output(t) == pytest.approx(mhe.output(start, t, asked.state(t), start.p), rel=1e-14)
    for t in np.arange(since, since + 1.0, 0.05):  # and along a run, step by step
        asked = asked.at(start, t)
        at_once = Follower(mhe, start).forecast
        assert asked.covariance(t) == pytest.approx(at_once.covariance(t), rel=1e-7)  # edges within 1e-9 are one
