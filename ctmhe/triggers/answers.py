"""Policies are asked, and what they answer is checked: errors name the policy, the time and the remedy."""

from __future__ import annotations

import re
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ctmhe.errors import TriggerError
from ctmhe.triggers.base import Trigger, TriggerContext

QUESTIONS = ("fires", "guard", "next_time")

IN_PLACE = re.compile(r"read-only|cannot assign to field|'?(mappingproxy|tuple|frozenset)'? object|to tuple")
"""What Python says when something in a context or in a memory is changed in place."""


def kind_of(policy: Trigger) -> str:
    """Return which of `fires`, `guard` and `next_time` a policy answers."""
    if not isinstance(policy, Trigger):
        hint = "call the class" if isinstance(policy, type) else "decorate a function with @trigger"
        raise TriggerError(f"{policy!r} is not a Trigger; {hint}")
    written = [name for name in QUESTIONS if getattr(type(policy), name) is not getattr(Trigger, name)]
    if len(written) != 1:
        raise TriggerError(
            f"policy {policy!r} must define exactly one of {', '.join(QUESTIONS)}; it defines "
            f"{', '.join(written) or 'none'}. Write two policies and join them with | or &"
        )
    return written[0]


def call(policy: Trigger, method: str, ctx: TriggerContext, *arguments: Any) -> Any:
    """Call a method of a policy; whatever it raises becomes a `TriggerError` that names the policy and the time."""
    try:
        return getattr(policy, method)(ctx, *arguments)
    except TriggerError:
        raise
    except Exception as error:
        hint = ""
        if isinstance(error, (ValueError, TypeError, AttributeError)) and IN_PLACE.search(str(error)):
            hint = (
                "; the context and the memory in it are read-only (lists are kept as tuples, sets as frozensets): "
                "copy before changing, and return the new memory from update()"
            )
        raise TriggerError(
            f"policy {policy!r}: {method} failed at t = {ctx.t:.9g}: {type(error).__name__}: {error}{hint}"
        ) from error


def ask_level(policy: Trigger, ctx: TriggerContext) -> float:
    """Return the checked value of `guard`."""
    value = call(policy, "guard", ctx)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TriggerError(
            f"policy {policy!r}: guard returned {value!r} at t = {ctx.t:.9g}; expected a number that reaches zero when "
            "a sample is due (for yes or no, write fires or use @trigger)"
        )
    if np.isnan(value):
        raise TriggerError(
            f"policy {policy!r}: guard returned NaN at t = {ctx.t:.9g}. ctx.y_last is NaN before the first sample "
            "(ctx.samples == 0) and ctx.y where a sensor has no value: return inf or -inf there"
        )
    return float(value)


def ask_yes(policy: Trigger, ctx: TriggerContext) -> bool:
    """Return the checked answer of `fires`."""
    value = call(policy, "fires", ctx)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if not isinstance(value, (bool, np.bool_)):
        hint = " (is a return missing?)" if value is None else ""
        raise TriggerError(f"policy {policy!r} returned {value!r} at t = {ctx.t:.9g}; expected True or False{hint}")
    return bool(value)


def ask_time(policy: Trigger, ctx: TriggerContext, earliest: float) -> float:
    """Return the checked answer of `next_time`: not NaN and not before `earliest`."""
    value = call(policy, "next_time", ctx)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TriggerError(
            f"policy {policy!r}: next_time returned {value!r} at t = {ctx.t:.9g}; expected an absolute time in "
            "seconds, inf for never"
        )
    if not value >= earliest:
        raise TriggerError(
            f"policy {policy!r}: next_time returned {value!r} at t = {ctx.t:.9g}, which does not lie ahead; return an "
            "absolute time after ctx.t (ctx.t + wait), inf for never"
        )
    return float(value)


def initial_memory(policy: Trigger) -> Any:
    """Return the policy's memory at the start of a run, made immutable."""
    try:
        return protected(policy.init_state())
    except Exception as error:
        raise TriggerError(f"policy {policy!r}: init_state failed: {type(error).__name__}: {error}") from error


def remember(policy: Trigger, ctx: TriggerContext, state: Any, fired: bool) -> Any:
    """Return the policy's memory after `update`, made immutable."""
    return protected(call(policy, "update", replace(ctx, state=state), fired))


def settle(policy: Trigger, ctx: TriggerContext, state: Any) -> Any:
    """Return the policy's memory after `after_sample`, made immutable."""
    return protected(call(policy, "after_sample", replace(ctx, state=state)))


def protected(memory: Any) -> Any:
    """Return a memory that a policy cannot change in place, so that runs that share its past stay apart.

    Arrays become read-only copies, mappings read-only views of copies, lists tuples and sets frozensets, all the way
    down; values of other types are kept as they are.
    """
    if isinstance(memory, np.ndarray):
        array = memory.copy()
        array.setflags(write=False)
        return array
    if isinstance(memory, (dict, MappingProxyType)):
        return MappingProxyType({key: protected(value) for key, value in memory.items()})
    if isinstance(memory, list) or type(memory) is tuple:
        return tuple(protected(value) for value in memory)
    return frozenset(memory) if isinstance(memory, set) else memory
