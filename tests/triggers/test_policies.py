"""Elementary policies: what they answer, and what happens when they answer nonsense."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.errors import InputError, TriggerError
from ctmhe.triggers import (
    Innovation,
    MaxInterval,
    MinInterval,
    Periodic,
    Scheduled,
    SendOnDelta,
    Trigger,
    Watch,
    build_trigger,
    load_trigger,
    trigger,
)
from tests.triggers.walking import context, level


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(0, 3))
def test_send_on_delta_fires_exactly_when_an_output_has_moved_by_delta(y, y_last, delta):
    """The guard is |y - y_last| - delta."""
    assert SendOnDelta(delta).guard(context(y=[y], y_last=[y_last])) == abs(y - y_last) - delta


def test_send_on_delta_takes_its_first_sample_at_once_unless_infinite():
    """Before the first sample every finite threshold is exceeded, an infinite one never."""
    first = context(y=[1.0], y_last=[np.nan], samples=0)
    assert SendOnDelta(0.1).guard(first) == np.inf
    assert SendOnDelta(np.inf).guard(first) == -np.inf


def test_send_on_delta_watches_the_named_outputs_and_passes_over_silent_sensors():
    """A mapping selects outputs; NaN means that a sensor has nothing to say."""
    ctx = context(y=[9.0, 1.0], y_last=[0.0, 0.0])
    assert SendOnDelta({"b": 2.0}).guard(ctx) == -1.0
    assert SendOnDelta([1.0, 0.5]).guard(ctx) == 8.0
    assert SendOnDelta(0.5).guard(context(y=[np.nan, 1.0], y_last=[0.0, 0.0])) == 0.5
    assert SendOnDelta(0.5).guard(context(y=[np.nan], y_last=[0.0])) == -np.inf


def test_innovation_measures_the_distance_from_the_prediction():
    """Norms over the outputs, and Mahalanobis' with a covariance."""
    ctx = context(y=[3.0, 4.0], y_last=[0.0, 0.0], y_hat=[0.0, 0.0])
    assert Innovation(1.0).guard(ctx) == 3.0
    assert Innovation(1.0, norm="euclidean").guard(ctx) == 4.0
    assert Innovation(0.0, covariance=[9.0, 4.0]).guard(ctx) == pytest.approx(np.sqrt(1.0 + 4.0))
    covariance = np.array([[2.0, 1.0], [1.0, 3.0]])
    expected = np.sqrt(np.array([3.0, 4.0]) @ np.linalg.inv(covariance) @ np.array([3.0, 4.0]))
    assert Innovation(0.0, covariance=covariance).guard(ctx) == pytest.approx(expected)


@given(st.floats(0, 1e3), st.floats(1e-3, 10.0))
def test_periodic_names_the_next_multiple_of_its_period(t, period):
    """The next time lies ahead, by one period at most, and is a multiple."""
    due = Periodic(period).next_time(context(t=t))
    assert t < due <= t + period * (1 + 1e-9) + 3e-6
    assert due / period == pytest.approx(round(due / period), abs=1e-9)


def test_scheduled_goes_through_its_times_and_then_rests():
    """Times before the start are skipped; after the last comes nothing."""
    policy = Scheduled([0.5, 1.0, 2.5])
    assert policy.next_time(context(t=1.0, samples=0)) == 1.0
    assert policy.next_time(context(t=1.0, samples=1)) == 2.5
    assert policy.next_time(context(t=2.5)) == np.inf


def test_longest_wait_is_declared_by_time_policies_and_composed():
    """`|` waits no longer than the shortest, `&` no longer than the longest; a guard declares nothing."""
    guard = SendOnDelta(0.1)
    assert guard.longest_wait == np.inf
    assert (guard | MaxInterval(0.2)).longest_wait == 0.2
    assert (guard & MaxInterval(0.2)).longest_wait == np.inf
    assert (Periodic(0.1) & MinInterval(0.3)).longest_wait == 0.3
    assert Scheduled([0, 0.1, 0.5]).longest_wait == pytest.approx(0.4)


def test_or_takes_the_largest_level_and_and_the_smallest():
    """Composition of guards is max and min, in any nesting."""
    ctx = context(y=[1.0], y_last=[0.0])
    low, high = SendOnDelta(1.5), SendOnDelta(0.25)
    assert level(low | high, ctx) == 0.75
    assert level(low & high, ctx) == -0.5
    assert level((low & high) | high, ctx) == 0.75
    assert level(low & (high | low), ctx) == -0.5


class Raises(Trigger):
    def guard(self, ctx):
        raise ZeroDivisionError("oops")


class Returns(Trigger):
    def __init__(self, value):
        self.value = value

    def guard(self, ctx):
        return self.value


class ReturnsTime(Returns):
    guard = Trigger.guard

    def next_time(self, ctx):
        return self.value


class Writes(Trigger):
    def guard(self, ctx):
        ctx.y[0] = 1.0
        return -1.0


class Assigns(Trigger):
    def guard(self, ctx):
        ctx.t = 0.0
        return -1.0


class Silent(Trigger):
    pass


class Both(Returns):
    def next_time(self, ctx):
        return 1.0


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Raises(), "Raises.*ZeroDivisionError: oops"),
        (Returns(np.nan), "Returns.*NaN at t = 1"),
        (Returns(None), "Returns.*None"),
        (Returns(True), "Returns.*True.*@trigger"),
        (Returns("yes"), "Returns.*'yes'"),
        (ReturnsTime(np.nan), "ReturnsTime.*nan.*does not lie ahead"),
        (ReturnsTime(0.5), "ReturnsTime.*0.5.*does not lie ahead"),
        (ReturnsTime(None), "ReturnsTime.*None"),
        (trigger(lambda ctx: None), "lambda.*None.*return missing"),
        (trigger(lambda ctx: 1.0), "lambda.*1.0.*True or False"),
        (trigger(lambda ctx: ctx.nothing), "lambda.*AttributeError"),
        (Writes(), "Writes.*read-only"),
        (Assigns(), "Assigns.*read-only"),
        (Silent(), "Silent.*exactly one of fires, guard, next_time; it defines none"),
        (Both(1.0), "Both.*it defines guard, next_time"),
    ],
)
def test_a_policy_that_fails_or_returns_nonsense_is_reported_by_name(policy, message):
    """No failure is swallowed: the error names the policy, the time and what came back."""
    with pytest.raises(TriggerError, match=message):
        level(policy, context())


@pytest.mark.parametrize(
    "make",
    [
        lambda: SendOnDelta(-1.0),
        lambda: SendOnDelta({"a": np.nan}),
        lambda: SendOnDelta([0.1, 0.2], outputs="a"),
        lambda: Innovation(-1.0),
        lambda: Innovation(1.0, norm="largest"),
        lambda: Innovation(1.0, covariance=[[1.0, 2.0], [2.0, 1.0]]),
        lambda: Periodic(0.0),
        lambda: MinInterval(np.inf),
        lambda: MaxInterval(-1.0),
        lambda: Scheduled([1.0, 1.0]),
        lambda: Scheduled([]),
        lambda: build_trigger({"name": "SendOnDelta", "treshold": 1.0}),
        lambda: build_trigger({"name": "SendOnDelt", "delta": 1.0}),
        lambda: build_trigger("mine.py:Name"),
        lambda: build_trigger({"any": []}),
        lambda: build_trigger({}),
        lambda: SendOnDelta(1.0) | (lambda ctx: True),
        lambda: load_trigger("nowhere.py:Name"),
        lambda: load_trigger("nowhere"),
    ],
)
def test_wrong_settings_raise_when_the_policy_is_made(make):
    """A policy that cannot work is refused before any run."""
    with pytest.raises(InputError):
        make()


def test_an_unknown_output_is_named_with_its_policy():
    """The error names the output, and the policy that asked for it."""
    with pytest.raises(TriggerError, match=r"SendOnDelta.*unknown output 'z'"):
        level(SendOnDelta({"z": 1.0}), context())


def test_a_configuration_builds_what_python_builds():
    """Tables of name and arguments, joined by any and all."""
    spec = {"any": [{"name": "SendOnDelta", "delta": 0.05}, {"name": "MaxInterval", "seconds": 0.19}]}
    assert repr(build_trigger(spec)) == repr(SendOnDelta(0.05) | MaxInterval(0.19))
    spec = {"all": [spec, {"name": "MinInterval", "seconds": 0.01}]}
    assert (
        repr(build_trigger(spec)) == "(SendOnDelta(delta=0.05) | MaxInterval(seconds=0.19)) & MinInterval(seconds=0.01)"
    )


def test_a_policy_loads_from_a_users_file(tmp_path):
    """file.py:Name may be a decorated function, a plain function, a class or an instance."""
    file = tmp_path / "mine.py"
    file.write_text(
        "from ctmhe.triggers import Trigger, trigger\n"
        "@trigger\ndef drifted(ctx): return True\n"
        "def plain(ctx): return False\n"
        "class Crossing(Trigger):\n    def guard(self, ctx): return ctx.y[0]\n"
        "number = 3\n"
    )
    assert level(load_trigger(f"{file}:drifted"), context()) == np.inf
    assert level(load_trigger(f"{file}:plain"), context()) == -np.inf
    assert level(load_trigger(f"{file}:Crossing"), context(y=[2.0])) == 2.0
    with pytest.raises(InputError, match=r"no 'Crosing'.*drifted, Crossing"):
        load_trigger(f"{file}:Crosing")
    with pytest.raises(TriggerError, match="neither a policy nor a function"):
        load_trigger(f"{file}:number")
    (tmp_path / "broken.py").write_text("1 / 0")
    with pytest.raises(TriggerError, match="ZeroDivisionError"):
        load_trigger(f"{tmp_path / 'broken.py'}:x")


@trigger
def always(ctx):
    return True


def test_policies_pickle_to_themselves():
    """Policies travel to worker processes; a decorated function by its name."""
    assert pickle.loads(pickle.dumps(always)) is always
    policy = (SendOnDelta(0.1) | Innovation(2.0, covariance=1.0)) & MinInterval(0.1)
    assert repr(pickle.loads(pickle.dumps(policy))) == repr(policy)


class Counting(Trigger):
    """Samples at every third monitoring time; memory lives in ctx.state."""

    def init_state(self):
        return 0

    def fires(self, ctx):
        return ctx.state >= 2

    def update(self, ctx, fired):
        return 0 if fired else ctx.state + 1


def test_memory_is_explicit_so_that_one_policy_serves_many_runs():
    """Two watches over one policy do not see each other's memory."""
    watch, ctx = Watch(Counting()), context()
    first = watch.monitored(watch.start(ctx), ctx)
    first = watch.monitored(first, ctx)
    second = watch.start(ctx)
    assert watch.level(watch.ask(first, ctx), ctx) == np.inf
    assert watch.level(watch.ask(second, ctx), ctx) == -np.inf
    assert watch.level(watch.ask(watch.sampled(first, ctx, ctx), ctx), ctx) == -np.inf
