"""Policies by name: from a user's file, from installed packages, and from a configuration."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from difflib import get_close_matches
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from ctmhe.errors import InputError, TriggerError
from ctmhe.triggers.answers import kind_of
from ctmhe.triggers.base import Trigger, trigger
from ctmhe.triggers.budget import Budget, DutyCycle, TokenBucket
from ctmhe.triggers.compose import And, Hysteresis, MaxInterval, MinInterval, Or
from ctmhe.triggers.covariance import CovarianceBound, CovarianceSelfTriggered
from ctmhe.triggers.crossing import LevelCrossing
from ctmhe.triggers.energy import InnovationEnergy
from ctmhe.triggers.gaps import GeometricGaps, Jittered, LinearGaps, Poisson
from ctmhe.triggers.information import Excitation
from ctmhe.triggers.innovation import Innovation, Stochastic
from ctmhe.triggers.phases import During, Phases
from ctmhe.triggers.threshold import Deadband, SendOnArea, SendOnDelta, SendOnSlope
from ctmhe.triggers.timing import Periodic, Scheduled

GROUP = "ctmhe.triggers"
POLICIES: tuple[type[Trigger], ...] = (
    *(Periodic, Scheduled, Jittered, Poisson, LinearGaps, GeometricGaps),
    *(SendOnDelta, SendOnArea, SendOnSlope, Deadband, LevelCrossing),
    *(Innovation, InnovationEnergy, Stochastic),
    *(CovarianceBound, CovarianceSelfTriggered, Excitation),
    *(TokenBucket, DutyCycle, Budget),
    *(MinInterval, MaxInterval, Hysteresis, During),
)
BUILT_IN: dict[str, type[Trigger]] = {kind.__name__: kind for kind in POLICIES}

JOINED = ("any", "all", "phases")
"""Keys of tables that join policies."""


def load_trigger(location: str) -> Trigger:
    """Return the policy `file.py:Name`: a policy, a policy class without arguments, or a function of the context.

    The file is executed. Never feed this from a configuration that somebody else may have written.

    Raises
    ------
    InputError
        If the text is not `file.py:Name`, or there is no such file or name in it.
    TriggerError
        If the file fails when executed, or the name is not a policy.
    """
    module, name = execute_file(location, "trigger")
    if not hasattr(module, name):
        found = [key for key, value in vars(module).items() if _is_policy(value, module.__name__)]
        raise InputError(f"trigger {location!r}: no {name!r} in it. Policies there: {', '.join(found) or 'none'}")
    return _as_policy(getattr(module, name), f"trigger {location!r}", {})


def execute_file(location: str, what: str) -> tuple[ModuleType, str]:
    """Execute the file of `file.py:Name`; return its module and the name, which may be missing in it.

    Raises
    ------
    InputError
        If the text is not `file.py:Name`, or there is no such file.
    TriggerError
        If the file fails when executed.
    """
    file, colon, name = location.rpartition(":")
    path = Path(file)
    if not colon or not name or path.suffix != ".py":
        raise InputError(f"{what} {location!r}: expected file.py:Name")
    if not path.is_file():
        raise InputError(f"{what} {location!r}: no file {file!r}")
    spec = importlib.util.spec_from_file_location(f"ctmhe_user_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"{what} {location!r}: {file!r} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[spec.name]
        raise TriggerError(f"{what} {location!r}: {file} failed: {type(error).__name__}: {error}") from error
    return module, name


def build_trigger(spec: str | Mapping[str, Any]) -> Trigger:
    """Return the policy that a configuration describes.

    Parameters
    ----------
    spec : str or mapping
        A name; `{name = "SendOnDelta", delta = 0.05}`, the other keys being its arguments, policies among them; or
        several joined: `{any = [...]}` for `|`, `{all = [...]}` for `&`, and `{phases = [[2.0, ...], ...]}` for
        `Phases`, whose list holds pairs of a time and a policy, and the last policy alone. Names are those of this
        package and of the entry-point group `ctmhe.triggers`; files are not loaded from a configuration.

    Raises
    ------
    InputError
        For unknown names and arguments.
    """
    if isinstance(spec, str):
        spec = {"name": spec}
    if not isinstance(spec, Mapping):
        raise InputError(f"trigger: expected a name or a table, got {spec!r}")
    for key in JOINED:
        if key in spec:
            parts = spec[key]
            if len(spec) > 1 or not isinstance(parts, (list, tuple)) or not parts:
                raise InputError(f"trigger: {key} takes a list of policies and stands alone, got {dict(spec)!r}")
            if key == "phases":
                return Phases(*map(_phase, parts))
            policies = [build_trigger(part) for part in parts]
            return policies[0] if len(policies) == 1 else (Or if key == "any" else And)(*policies)
    arguments = dict(spec)
    name = arguments.pop("name", None)
    if not isinstance(name, str):
        raise InputError(f"trigger: a table needs name, {', '.join(JOINED[:-1])} or phases, got {dict(spec)!r}")
    arguments = {key: build_trigger(value) if _describes(value) else value for key, value in arguments.items()}
    return _as_policy(_named(name), f"trigger {name!r}", arguments)


def _describes(value: Any) -> bool:
    """Return whether an argument is a policy's table, not a mapping of signals to numbers."""
    if not isinstance(value, Mapping):
        return False
    return isinstance(value.get("name"), str) or any(isinstance(value.get(key), (list, tuple)) for key in JOINED)


def _phase(part: Any) -> Any:
    if isinstance(part, (list, tuple)):
        return part if len(part) != 2 else (part[0], build_trigger(part[1]))
    return build_trigger(part)


def _named(name: str) -> Any:
    if name in BUILT_IN:
        return BUILT_IN[name]
    installed = {point.name: point for point in entry_points(group=GROUP)}
    if name in installed:
        try:
            return installed[name].load()
        except Exception as error:
            raise TriggerError(f"trigger {name!r} of {installed[name].value} failed to load: {error}") from error
    known = [*BUILT_IN, *installed]
    if ".py" in name:
        raise InputError(f"trigger {name!r}: a configuration may not name a file; use --trigger on the command line")
    near = get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise InputError(f"unknown trigger {name!r}{hint} Known: {', '.join(known)}")


def _as_policy(value: Any, what: str, arguments: Mapping[str, Any]) -> Trigger:
    if isinstance(value, type) and issubclass(value, Trigger):
        try:
            value = value(**arguments)
        except TypeError as error:
            raise InputError(f"{what}: {error}") from error
    elif arguments:
        raise InputError(f"{what} takes no arguments, got {', '.join(arguments)}")
    if not isinstance(value, Trigger):
        if not callable(value) or isinstance(value, type):
            raise TriggerError(f"{what} is {value!r}, neither a policy nor a function of the context")
        function: Any = value
        value = trigger(function)
    if not isinstance(value, (Or, And)):
        kind_of(value)
    return value


def _is_policy(value: Any, module: str) -> bool:
    is_class = isinstance(value, type) and issubclass(value, Trigger)
    return (is_class or isinstance(value, Trigger)) and getattr(value, "__module__", "") == module
