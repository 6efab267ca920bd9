"""What holds for every policy: it pickles, prints as it was made, is found by name, and refuses nonsense."""

import pickle
from dataclasses import fields, is_dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ctmhe
import ctmhe.triggers
from ctmhe.errors import InputError
from ctmhe.triggers import (
    Budget,
    CovarianceBound,
    CovarianceSelfTriggered,
    Deadband,
    During,
    DutyCycle,
    Excitation,
    GeometricGaps,
    Hysteresis,
    Innovation,
    InnovationEnergy,
    Jittered,
    LevelCrossing,
    LinearGaps,
    MaxInterval,
    MinInterval,
    Periodic,
    Phases,
    Poisson,
    Scheduled,
    SendOnArea,
    SendOnDelta,
    SendOnSlope,
    Stochastic,
    TokenBucket,
    build_trigger,
)
from ctmhe.triggers.loading import BUILT_IN
from tests.triggers.walking import walk


def slope(ctx):
    """Return how far the output has moved since it was sent; without a sample, nothing."""
    return float(abs(ctx.y[0] - ctx.y_last[0])) if ctx.samples else 0.0


POLICIES = [
    Periodic(0.13, start=0.05),
    Jittered(0.13, 0.1, seed=3),
    Poisson(5.0, seed=2),
    LinearGaps(0.01, 0.19, 20),
    GeometricGaps(0.02, 1.3, longest=0.3),
    SendOnDelta(0.2),
    SendOnDelta({"a": 0.2}),
    SendOnArea([0.05], outputs="a"),
    SendOnSlope(0.05),
    Deadband(0.1, 0.05),
    LevelCrossing([0.1, 0.5], hysteresis=0.02),
    Innovation(0.3, norm="euclidean"),
    Innovation(2.0, covariance=[0.01]),
    InnovationEnergy(0.05, 0.4, R=2.0, floor=0.01),
    Stochastic(20.0, seed=1),
    CovarianceBound(0.4, {"x": 2.0}) | MaxInterval(0.5),
    CovarianceSelfTriggered(0.3, "x", longest=1.0),
    Excitation(slope, 0.2) | MaxInterval(0.3),
    SendOnDelta(0.02) & TokenBucket(4.0, 2.0),
    SendOnDelta(0.02) & DutyCycle(0.5, 0.2, start=0.1),
    Budget(SendOnDelta(0.2) | MinInterval(0.5), 12, 2.0),
    Budget(SendOnDelta(0.1), 5, 2.0, start=0.2, freedom=3.0) | Periodic(0.5),
    Hysteresis(Innovation(0.2), 0.1),
    SendOnDelta(0.1) & During(0.5, np.inf) & MinInterval(0.1),
    Phases((0.5, LinearGaps(0.01, 0.1, 5)), (1.0, SendOnDelta(0.1) & MinInterval(0.05)), Periodic(0.2)),
]
every = pytest.mark.parametrize("policy", POLICIES, ids=lambda policy: repr(policy)[:40])


def samples(policy):
    """Return the times at which a policy samples a wave."""
    return walk(policy, 2.0, lambda t: np.sin(3 * t), spread=lambda t, last: 0.01 + 0.5 * (t - last))


@every
def test_a_policy_pickles_and_prints_as_what_it_is(policy):
    """The copy that travels, and the one made from the text, take the same samples; a second run does, too."""
    times = samples(policy)
    assert times.size > 0
    copy = pickle.loads(pickle.dumps(policy))
    assert repr(copy) == repr(policy)
    np.testing.assert_array_equal(samples(copy), times)
    if not any(isinstance(part, Excitation) for part in getattr(policy, "parts", ())):
        made = eval(repr(policy), vars(ctmhe.triggers) | {"inf": np.inf})
        assert repr(made) == repr(policy)
        np.testing.assert_array_equal(samples(made), times)
    np.testing.assert_array_equal(samples(policy), times)


@every
def test_a_policy_keeps_the_promise_of_its_longest_wait(policy):
    """No gap is longer than declared, up to a monitoring step for what is asked at monitoring times only."""
    gaps = np.diff(samples(policy), prepend=0.0)
    assert gaps.max() <= policy.longest_wait + 0.01 + 1e-6


def test_every_policy_has_a_name_an_export_and_a_source_or_reason():
    """By name in a configuration, in ctmhe and ctmhe.triggers, and with a docstring that says what decides."""
    for name, kind in BUILT_IN.items():
        assert getattr(ctmhe, name) is getattr(ctmhe.triggers, name) is kind
        assert name in ctmhe.__all__ and name in ctmhe.triggers.__all__
        assert kind.__doc__ and "Parameters" in kind.__doc__


numbers = st.one_of(
    st.floats(), st.integers(-3, 3), st.booleans(), st.none(), st.text(max_size=3), st.lists(st.floats(), max_size=2)
)


@settings(max_examples=300)
@given(st.sampled_from(sorted(BUILT_IN)), st.lists(numbers, max_size=4))
def test_a_policy_is_made_or_refused_with_a_reason(name, arguments):
    """Whatever the arguments, the outcome is a policy with finite fields or an InputError that names it."""
    kind = BUILT_IN[name]
    keys = [item.name for item in fields(kind)] if is_dataclass(kind) else ["policy", "samples", "until", "freedom"]
    try:
        policy = build_trigger({"name": name, **dict(zip(keys, arguments, strict=False))})
    except InputError as error:
        assert name in str(error)
    else:
        assert isinstance(policy, kind) and repr(policy).startswith(name)
        assert policy.longest_wait > 0


def test_a_configuration_holds_policies_inside_policies():
    """Tables with a name, any, all or phases become policies wherever a policy is expected."""
    delta = {"name": "SendOnDelta", "delta": {"a": 0.1}}
    spec = {"name": "Budget", "policy": {"any": [delta, {"name": "Poisson", "rate": 3.0}]}, "samples": 10, "until": 5.0}
    assert repr(build_trigger(spec)) == repr(Budget(SendOnDelta({"a": 0.1}) | Poisson(3.0), 10, 5.0))
    spec = {"name": "Hysteresis", "policy": delta, "release": 0.05}
    assert repr(build_trigger(spec)) == repr(Hysteresis(SendOnDelta({"a": 0.1}), 0.05))
    spec = {"phases": [[2.0, {"name": "Periodic", "period": 0.1}], {"all": [delta, "Stochastic"]}]}
    assert repr(build_trigger(spec)) == repr(Phases((2.0, Periodic(0.1)), SendOnDelta({"a": 0.1}) & Stochastic()))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"phases": [[2.0, "Stochastic"]]}, "last policy"),
        ({"phases": [[2.0, "Stochastic", 1], "Stochastic"]}, "pair"),
        ({"phases": "Stochastic"}, "phases takes a list"),
        ({"name": "Budget", "policy": {"name": "Periodik", "period": 1}, "samples": 5, "until": 1.0}, "'Periodic'"),
        ({"name": "Budget", "policy": 3, "samples": 5, "until": 1.0}, "not a Trigger"),
        ("SendOnArae", "did you mean 'SendOnArea'"),
        ({"name": "Poisson"}, "rate"),
    ],
)
def test_a_configuration_that_fits_nothing_says_what_is_wrong(spec, message):
    """The error names the nearest policy, or what was expected."""
    with pytest.raises(InputError, match=message):
        build_trigger(spec)


def test_a_schedule_of_times_prints_shortly():
    """Its times are many: it is the one policy that does not print as it was made."""
    assert repr(Scheduled(np.arange(50.0))) == "Scheduled(50 times from 0 to 49)"
    assert all(b - a == 1.0 for a, b in pairwise(samples(Scheduled([0.0, 1.0, 2.0]))))
