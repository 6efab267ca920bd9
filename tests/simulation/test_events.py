"""Laws of event location: how exact, at what cost, and what a policy's failure leaves behind."""

import casadi as ca
import numpy as np
import pytest

from ctmhe.errors import FmuUnsupportedError, InputError, TriggerError
from ctmhe.estimators import MHE
from ctmhe.models.continuous import ContinuousModel
from ctmhe.simulation import FmuPlant, OdePlant, SingleSample, Uniform, simulate
from ctmhe.transcription.integrators import RK4
from ctmhe.triggers import MaxInterval, Periodic, SendOnDelta, Trigger
from ctmhe.types import DiscountedCost

SWING = ContinuousModel(
    lambda t, x, u, w, p: ca.vertcat(x[1], -x[0]),
    lambda t, x, u, w, p: x[0],
    x=("angle", "speed"),
    y="angle_seen",
    name="swing",
)
FIRST = float(np.arcsin(0.5))  # where sin(t) = 1/2 for the first time
CROSSINGS = [base + 2 * np.pi * k for k in range(3) for base in (FIRST, np.pi - FIRST)]
SCIKITS = pytest.mark.skipif("not __import__('ctmhe.simulation.integration').simulation.integration.has_sundials()")


class Crossing(Trigger):
    """Fires whenever the first output crosses `at`, in either direction; counts its questions."""

    def __init__(self, at=0.5):
        self.at, self.asked = at, 0

    def init_state(self):
        return 1.0  # below

    def guard(self, ctx):
        self.asked += 1
        return ctx.state * (ctx.y[0] - self.at) - 1e-13  # past it, or it would be silent after its own sample

    def update(self, ctx, fired):
        return -ctx.state if fired else ctx.state


@pytest.fixture(scope="module")
def mhe():
    cost = DiscountedCost(P=1.0, R_point=1.0)
    return MHE(SWING, horizon=4.0, interval=0.25, integrator=RK4(step=0.25), cost=cost, hold="point")


def run(plant, mhe, policy, **changes):
    options = {"until": 18.0, "guess": [0.0, 1.0], "truth": [0.0, 1.0], "monitor": 0.25, "channel": SingleSample()}
    return simulate(plant, mhe, trigger=policy, **(options | changes))


@SCIKITS
def test_cvode_finds_crossings_to_1e_8_seconds_with_few_questions(mhe):
    """Level crossings of sin(t) are known; polling to the same tolerance would ask 1e8 times a second."""
    policy = Crossing()
    result = run(OdePlant(SWING), mhe, policy)
    assert np.abs(result.sample_times - CROSSINGS).max() < 1e-8
    assert result.dataset.attrs["location"] == "roots found by CVODE"
    assert policy.asked < 100 * 18


@SCIKITS
def test_the_time_of_an_event_is_as_exact_as_the_solution(mhe):
    """A hundred times smaller tolerances of the plant, and no longer way to go: less than a tenth of the error."""
    errors = [
        np.abs(run(OdePlant(SWING, rtol=rtol, atol=1e-14), mhe, Crossing()).sample_times - CROSSINGS).max()
        for rtol in (1e-8, 1e-10, 1e-12)
    ]
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.3 * errors[1]


@SCIKITS
def test_cvode_sees_crossings_that_come_back_before_the_next_monitoring_time(mhe):
    """sin(t) is above 0.999 for 0.09 s, the monitoring step is 1 s."""
    result = run(OdePlant(SWING), mhe, Crossing(0.999), until=3.0, monitor=1.0)
    np.testing.assert_allclose(result.sample_times, [np.arcsin(0.999), np.pi - np.arcsin(0.999)], atol=1e-8)


@SCIKITS
def test_sampling_does_not_touch_the_plant(mhe):
    """Where no signal jumps, the true state is the same to the last bit whatever the policy."""
    runs = [run(OdePlant(SWING), mhe, policy, until=6.0) for policy in (Crossing(), SendOnDelta(0.2), Periodic(0.7))]
    for other in runs[1:]:
        np.testing.assert_array_equal(other.dataset["x_true"], runs[0].dataset["x_true"])


def test_going_back_finds_crossings_to_the_tolerance_asked_for(mhe):
    """Not early, late by at most `locate` (and the plant's own error); a coarser tolerance asks less."""
    asked = []
    for locate in (1e-3, 1e-6, 1e-9):
        policy = Crossing()
        result = run(OdePlant(SWING, backend="casadi"), mhe, policy, locate=locate, until=6.0)
        late = result.sample_times - CROSSINGS[:2]
        assert (late > -1e-8).all()
        assert (late < locate + 1e-8).all()
        assert "rollback" in result.dataset.attrs["location"]
        asked.append(policy.asked)
    assert asked[0] <= asked[1] <= asked[2] < 1.0 / 1e-3


def test_polling_samples_at_monitoring_times_only(mhe):
    """With locate=None a guard fires at the first monitoring time after its crossing, and the run says so."""
    result = run(OdePlant(SWING), mhe, Crossing(), locate=None, until=6.0)
    np.testing.assert_allclose(result.sample_times, np.ceil(np.array(CROSSINGS[:2]) / 0.25) * 0.25, atol=1e-12)
    assert result.dataset.attrs["location"] == "polled every 0.25 s"


def test_a_jump_across_zero_fires_at_the_jump(mhe):
    """Measurement noise jumps at the edges of its cells, and so does a guard of the output."""
    noisy = ContinuousModel(
        lambda t, x, u, w, p: ca.vertcat(x[1], -x[0]),
        lambda t, x, u, w, p: x[0] + w[0],
        x=("angle", "speed"), w="v", y="angle_seen", name="noisy",
    )  # fmt: skip
    policy = SendOnDelta(0.3) | MaxInterval(2.0)
    result = run(noisy, mhe, policy, disturbance={"v": Uniform(0.4, interval=0.125)}, until=3.0, seed=3)
    level = result.dataset["y_sampled"].to_numpy()[:, 0]
    moved = np.abs(np.diff(level))
    assert (moved[result.gaps[1:] < 2.0 - 1e-9] >= 0.3 - 1e-9).all()
    on_edge = np.abs(result.sample_times / 0.125 - np.round(result.sample_times / 0.125)) < 1e-6
    assert on_edge.any()
    assert not on_edge.all()


@pytest.fixture(scope="module")
def ball():
    """An FMU whose height falls as h0 - g t^2 / 2 until it bounces."""
    from fmus.build import build

    return build("bouncing_ball", fmi=2)


@pytest.mark.parametrize("locate", [1e-5, 1e-9])
def test_an_fmu_plant_is_located_to_the_tolerance_asked_for(ball, locate):
    """A falling ball passes half its height at sqrt(h0 / g)."""
    plant = FmuPlant(ball)
    height = plant.y.names.index("y_height")
    plant.start(0.0, None)
    h0 = float(plant.output(np.zeros(len(plant.u)), np.zeros(len(plant.w)))[height])

    class Halfway(Trigger):
        asked = 0

        def guard(self, ctx):
            type(self).asked += 1
            return (h0 / 2 - ctx.y[0]) if not ctx.samples else -np.inf

    fall = ContinuousModel(
        lambda t, x, u, w, p: ca.vertcat(x[1], -9.81),
        lambda t, x, u, w, p: x[0],
        x=("height", "velocity"),
        y="y_height",
        name="fall",
    )
    estimator = MHE(fall, horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost(), hold="point")
    result = simulate(
        plant, estimator, trigger=Halfway(), until=0.44, guess=[h0, 0.0], monitor=0.11, channel=SingleSample(),
        locate=locate,
    )  # fmt: skip
    late = result.sample_times[0] - np.sqrt(h0 / 9.81)
    assert -1e-8 < late < locate + 1e-8
    assert Halfway.asked < 60 < 0.44 / locate
    plant.close()


def test_a_plant_that_cannot_go_back_says_what_to_do(mhe):
    """Co-simulation without saved states: an error at the start that names the policy and polling."""

    class OneWay(OdePlant):
        finds_roots = False

        def checkpoint(self):
            raise FmuUnsupportedError("this plant cannot go back.")

    policy = SendOnDelta(0.3)
    with pytest.raises(FmuUnsupportedError, match=r"cannot go back.*SendOnDelta.*locate=None"):
        run(OneWay(SWING), mhe, policy, until=1.0)
    assert run(OneWay(SWING), mhe, policy, until=1.0, locate=None).samples > 2
    assert run(OneWay(SWING), mhe, Periodic(0.3), until=1.0).samples == 4  # nothing to locate


def test_locate_must_be_a_positive_number_of_seconds(mhe):
    """Zero, negative and NaN are refused."""
    for wrong in (0.0, -1e-9, np.nan):
        with pytest.raises(InputError, match="locate"):
            run(SWING, mhe, Periodic(1.0), locate=wrong)


@pytest.mark.parametrize("locate", [None, 1e-9])
def test_a_policy_that_fails_leaves_the_run_up_to_there(mhe, locate):
    """The error names the policy and the time, and carries a usable run; the same until then as without the failure."""

    class Tired(Crossing):
        def guard(self, ctx):
            if self.asked == 40:
                raise ValueError("tired of questions")
            return super().guard(ctx)

        def __repr__(self):
            return "Tired()"

    with pytest.raises(TriggerError, match=r"policy Tired\(\): guard failed at t = .*tired of questions") as caught:
        run(SWING, mhe, Tired(), locate=locate)
    part, whole = caught.value.run, run(SWING, mhe, Crossing(), locate=locate)
    assert 0 < len(part.t) < len(whole.t)
    np.testing.assert_array_equal(part.dataset["x_online"], whole.dataset["x_online"][: len(part.t)])
    assert "Run of" in repr(part)


def test_a_policy_that_never_fires_is_named_in_the_log(mhe, caplog):
    """Open loop is a legal outcome, but hardly wanted."""
    result = run(SWING, mhe, SendOnDelta(np.inf), until=1.0)
    assert result.samples == result.solves == 0
    assert "policy SendOnDelta(delta=inf) never fired" in caplog.text
    assert "never fired" in repr(result)


def test_the_level_is_recorded(mhe):
    """On monitoring times: the guard's value, inf or -inf for policies that know only yes or no."""
    result = run(SWING, mhe, SendOnDelta(0.3), until=2.0, locate=None)
    y, t = result.dataset["y"].to_numpy()[:, 0], result.t
    last = np.array([y[t <= s][-1] for s in result.sample_times])
    for k, now in enumerate(t):
        before = result.sample_times < now - 1e-9
        expected = abs(y[k] - last[before][-1]) - 0.3 if before.any() else np.inf
        assert result.dataset["level"].to_numpy()[k] == pytest.approx(expected, abs=1e-12)
    assert (run(SWING, mhe, Periodic(0.7), until=2.0).dataset["level"].to_numpy()[1:2] == -np.inf).all()


def test_a_guard_that_comes_back_at_once_is_asked_at_monitoring_times_only(mhe, caplog):
    """Protected by default: no more than four samples a monitoring step, counted, and said once, by name."""

    class Restless(Trigger):
        def guard(self, ctx):
            return ctx.elapsed - 1e-6

        def __repr__(self):
            return "Restless()"

    result = run(SWING, mhe, Restless(), until=2.0)
    per_step, _ = np.histogram(result.sample_times, bins=np.append(result.t, np.inf) - 1e-9)
    assert per_step.max() <= 4
    assert result.hushed >= len(result.t) - 2
    assert caplog.text.count("policy Restless(): its guard reaches zero again") == 1
    assert "MinInterval" in caplog.text
