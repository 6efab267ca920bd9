"""Memory cannot be changed in place, and a policy that fails in the middle of a run is named with its time."""

import copy

import numpy as np
import pytest

from ctmhe.errors import TriggerError
from ctmhe.triggers import Trigger, Watch
from ctmhe.triggers.answers import protected
from tests.triggers.walking import context, walk


class Remembers(Trigger):
    """Keeps what it is given, and does something to it when asked."""

    def __init__(self, memory, change, where="guard"):
        self.memory, self.change, self.where = memory, change, where

    def __repr__(self):
        return "Remembers"

    def init_state(self):
        return copy.deepcopy(self.memory)

    def guard(self, ctx):
        if self.where == "guard":
            self.change(ctx.state)
        return -1.0

    def update(self, ctx, fired):
        return self.change(ctx.state) if self.where == "update" else ctx.state


CHANGES = {
    "array": (np.zeros(2), lambda m: m.__setitem__(0, 1.0)),
    "array added to": (np.zeros(2), lambda m: m.__iadd__(1.0)),
    "dict": ({"n": 0}, lambda m: m.__setitem__("n", 1)),
    "dict updated": ({"n": 0}, lambda m: m.update(n=1)),
    "list": ([1], lambda m: m.append(2)),
    "list entry": ([1], lambda m: exec("m[0] = 2", {"m": m})),
    "list extended": ([1], lambda m: m.__add__([2])),
    "set": ({1}, lambda m: m.add(2)),
    "array inside": ({"rows": [np.zeros(2)]}, lambda m: m["rows"][0].__setitem__(0, 1.0)),
    "tuple of dicts": (({"n": 0},), lambda m: exec("m[0]['n'] = 1", {"m": m})),
}


@pytest.mark.parametrize("where", ["guard", "update"])
@pytest.mark.parametrize("case", CHANGES)
def test_a_memory_changed_in_place_is_an_error_with_a_hint(case, where):
    """Whatever kind of container it is, and wherever it happens."""
    memory, change = CHANGES[case]
    watch, ctx = Watch(Remembers(memory, change, where)), context()
    with pytest.raises(TriggerError, match=r"Remembers.*read-only.*return the new memory from update"):
        state = watch.start(ctx)
        watch.level(watch.monitored(state, ctx), ctx)


def test_memory_is_a_copy_that_nobody_else_holds():
    """What update returned may be changed afterwards without effect on the run."""
    held = {"rows": [np.zeros(2)]}
    kept = protected(held)
    held["rows"][0][0] = 1.0
    held["n"] = 1
    assert kept["rows"][0][0] == 0.0 and "n" not in kept
    np.testing.assert_array_equal(protected(kept)["rows"][0], kept["rows"][0])  # and may be protected again
    for value in (None, 3, 2.5, "text", (1, 2)):
        assert protected(value) == value


def test_new_memory_may_be_made_from_the_old_one():
    """The ways of writing that leave the old one alone work: {**m}, m + (x,), m | {x}."""

    def grow(m):
        return {**m, "list": [*m["list"], 1], "set": m["set"] | {2}, "array": m["array"] + 1}

    watch, ctx = Watch(Remembers({"list": [], "set": set(), "array": np.zeros(1)}, grow, "update")), context()
    state = watch.monitored(watch.monitored(watch.start(ctx), ctx), ctx)
    memory = state.standings[0].memory
    assert memory["list"] == (1, 1) and memory["set"] == {2} and memory["array"][0] == 2.0


class Tired(Trigger):
    """Raises at the 100th question."""

    def init_state(self):
        return 0

    def fires(self, ctx):
        if ctx.state >= 99:
            raise RuntimeError("enough")
        return False

    def update(self, ctx, fired):
        return ctx.state + 1


def test_a_policy_that_raises_at_its_100th_call_is_named_with_the_time():
    """The 100th monitoring time of 0.01 s is t = 0.99."""
    with pytest.raises(TriggerError, match=r"Tired\(\).*fires failed at t = 0\.99: RuntimeError: enough"):
        walk(Tired(), 2.0)


class Settles(Trigger):
    """Remembers the level that its sample left behind."""

    def guard(self, ctx):
        return np.inf if ctx.samples == 0 else ctx.y[0] - ctx.y_last[0] - 1.0

    def update(self, ctx, fired):
        return ("updated", ctx.samples)

    def after_sample(self, ctx):
        return (*ctx.state, "settled", ctx.samples, ctx.y_last[0])


def test_memory_is_settled_after_the_sample_with_what_it_brought():
    """`after_sample` comes after `update` and sees the sample; it is not called at other times."""
    watch, before, after = (
        Watch(Settles()),
        context(y=[5.0], y_last=[np.nan], samples=0),
        context(y=[5.0], y_last=[5.0]),
    )
    state = watch.sampled(watch.start(before), before, after)
    assert state.standings[0].memory == ("updated", 0, "settled", 1, 5.0)
    state = watch.monitored(state, after)
    assert state.standings[0].memory == ("updated", 1)


def test_what_fails_after_a_sample_is_named():
    """As in every other method."""

    class Fails(Settles):
        def after_sample(self, ctx):
            raise KeyError("cost")

    watch, ctx = Watch(Fails()), context(y=[5.0])
    with pytest.raises(TriggerError, match=r"Fails.*after_sample failed at t = 1.*KeyError"):
        watch.sampled(watch.start(ctx), ctx, ctx)
