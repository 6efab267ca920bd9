"""What configurations have in common: TOML files, known keys, the tables [estimator], [guess] and [channel]."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ctmhe.errors import InputError
from ctmhe.estimators.mhe import MHE
from ctmhe.simulation import Everything, Network, SingleSample, WholeSignal
from ctmhe.simulation.channel import Channel
from ctmhe.transcription import CVODES, RK4
from ctmhe.types import Bounds, DiscountedCost

MODEL = (
    "kind",
    "step",
    "inputs",
    "outputs",
    "states",
    "parameters",
    "disturbances",
    "output_noise",
    "start",
    "allow_frozen_events",
    "check",
    "isolated",
)
"""Keys of the table [model] of an FMU."""
ESTIMATOR = ("horizon", "interval", "integrator", "cost", "bounds", "hold", "hold_limit", "input_hold", "solver")
INTEGRATORS = {"RK4": RK4, "CVODES": CVODES}
CHANNELS = {"WholeSignal": WholeSignal, "SingleSample": SingleSample, "Everything": Everything}


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raise `InputError` with the line where it is not valid."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"no configuration file {str(path)!r}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from None


def table_of(tables: Mapping[str, Any], name: str, where: str) -> dict[str, Any]:
    """Return the table `name`, empty when there is none; raise when it is something else."""
    table = tables.get(name, {})
    if not isinstance(table, Mapping):
        raise InputError(f"{where}: [{name}] is a table of keys and values, got {name} = {table!r}")
    return dict(table)


def check_keys(table: Iterable[str], known: Iterable[str], where: str) -> None:
    """Raise for a key that is not known, with the nearest one that is."""
    known = tuple(known)
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise InputError(f"{where}: unknown key {key!r}{hint} Known: {', '.join(known)}")


def choose(options: Mapping[str, Any], name: Any, what: str) -> Any:
    """Return the option called `name`."""
    if not isinstance(name, str) or name not in options:
        raise InputError(f"{what}: expected one of {', '.join(options)}, got {name!r}")
    return options[name]


def build_estimator(model: Any, table: Mapping[str, Any], where: str) -> MHE:
    """Return the estimator that the table [estimator] describes."""
    options = dict(table)
    for key in ("horizon",) if model.step else ("horizon", "interval"):
        if key not in options:
            raise InputError(f"{where}: table [estimator] needs {key} (seconds)")
    cost = dict(options.pop("cost", {}))
    bounds = options.pop("bounds", {})
    if not isinstance(bounds, Mapping) and bounds != "model":
        raise InputError(f'{where}: table [estimator]: bounds is a table, or "model" for the model\'s own: {bounds!r}')
    try:
        if not model.step:  # a step map has no integrator
            integrator = dict(options.pop("integrator", {"kind": "RK4", "step": options["interval"] / 5}))
            kind = choose(INTEGRATORS, integrator.pop("kind", None), "integrator kind")
            options["integrator"] = kind(**integrator)
        box = model.bounds if bounds == "model" else Bounds(**{key: box_of(value) for key, value in bounds.items()})
        return MHE(model, cost=DiscountedCost(**cost), bounds=box, **options)
    except TypeError as error:
        raise InputError(f"{where}: table [estimator]: {error}") from None


def build_channel(table: Mapping[str, Any], where: str) -> Channel:
    """Return the channel that the table [channel] describes: its kind and arguments, and [channel.network]."""
    options = dict(table)
    kind = choose(CHANNELS, options.pop("kind", "WholeSignal"), f"{where}: channel kind")
    network = options.pop("network", None)
    check_keys(options, [*(field.name for field in fields(kind)), "network"], f"{where}: table [channel]")
    channel = kind(**options)
    if network is None:
        return channel
    if not isinstance(network, Mapping):
        raise InputError(f"{where}: [channel.network] is a table of keys and values, got {network!r}")
    known = [field.name for field in fields(Network) if field.name != "channel"]
    check_keys(network, known, f"{where}: table [channel.network]")
    pairs: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in network.items()}
    return Network(channel, **pairs)


def build_guess(table: Mapping[str, Any], model: Any, where: str) -> tuple[dict[str, float], dict[str, float] | None]:
    """Return the initial states and parameters that the table [guess] names; an FMU knows the others itself."""
    check_keys(table, (*model.x.names, *model.p.names), f"{where}: table [guess]")
    for name, value in table.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{where}: table [guess]: {name} must be a number, got {value!r}")
    start = dict(zip(model.x.names, model.x_start, strict=True)) if hasattr(model, "x_start") else {}
    guess = start | {name: float(value) for name, value in table.items()}
    return guess, {name: guess.pop(name) for name in list(guess) if name in model.p.names} or None


def box_of(value: Any) -> Any:
    """Return a box of `Bounds`: a table of pairs, or one pair for all."""
    try:
        return {name: tuple(pair) for name, pair in value.items()} if isinstance(value, Mapping) else tuple(value)
    except TypeError:
        raise InputError(f"a box is a pair [lower, upper], or a table of such pairs; got {value!r}") from None
