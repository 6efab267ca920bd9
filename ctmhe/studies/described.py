"""A case described by tables of numbers and names: plant, estimator, trigger, channel. What a TOML file can hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import Any

from ctmhe.errors import InputError
from ctmhe.estimators.mhe import MHE
from ctmhe.models import library
from ctmhe.models.continuous import Model
from ctmhe.models.fmu import FmuModel
from ctmhe.simulation import FmuPlant, Gaussian, OdePlant, Plant, Run, Uniform, simulate
from ctmhe.studies.tables import build_channel, build_estimator, build_guess, choose
from ctmhe.triggers.loading import build_trigger

LIBRARY = ("model", "options")
"""Keys of a plant or model of the library."""
PROCESSES = {"Uniform": Uniform, "Gaussian": Gaussian}
PLANTS = ("batch_reactor", "cascaded_tanks", "chua", "cstr", "quadrotor", "van_der_pol")


@dataclass(frozen=True, eq=False)
class DescribedCase:
    """What the tables of a TOML file describe, as the case of a `Study`.

    It holds tables, numbers and paths only, so that it is small on its way to other processes; plants and estimators
    are built where it runs, once for each configuration.

    Attributes
    ----------
    tables : mapping
        The tables of the file, all but [grid]; of [study] what concerns a run. Paths are absolute.
    """

    tables: Mapping[str, Any]

    def __call__(self, *, seed: int, **point: Any) -> Run:
        """Do one run; `point` maps dotted keys, such as `trigger.delta`, or names of tables to values."""
        tables = changed(self.tables, point)
        running, about = tables["study"], tables["plant"]
        plant, mhe = build(tables)
        guess, p = build_guess(tables["guess"], mhe.model, "study")
        inputs = about.get("inputs")
        return simulate(
            plant,
            mhe,
            trigger=build_trigger(tables["trigger"]),
            until=running["until"],
            start=running.get("start", 0.0),
            monitor=running.get("monitor"),
            locate=running.get("locate", 1e-9) or None,  # TOML has no null; false stands for it
            guess=guess,
            p=p,
            truth=about.get("truth"),
            p_true=about.get("parameters"),
            channel=build_channel(tables["channel"], "study"),
            disturbance=build_disturbance(tables["disturbance"], "study"),
            inputs=inputs if isinstance(inputs, Mapping) and inputs else None,
            seed=seed,
        )


def changed(tables: Mapping[str, Any], point: Mapping[str, Any], where: str = "study") -> dict[str, Any]:
    """Return the tables with values replaced: whole tables first, then what dotted keys lead to.

    A part of a key is the name of a key, or a number that counts the entries of a list from 0: `trigger.any.0.delta`.
    """
    result = deepcopy(dict(tables))
    for key, value in sorted(point.items(), key=lambda item: item[0].count(".")):
        *path, last = key.split(".")
        place: Any = result
        for part in path:
            found: Any = place
            place = found[_position(part, found, key, where)] if isinstance(found, list) else found.setdefault(part, {})
            if not isinstance(place, (dict, list)):
                raise InputError(f"{where}: [grid] {key}: {part} is {place!r}, not a table")
        if isinstance(place, list):
            place[_position(last, place, key, where)] = value
        else:
            place[last] = deepcopy(value)
    return result


def build_disturbance(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return numbers and processes by signal."""
    processes = {}
    for name, value in table.items():
        processes[name] = value
        if isinstance(value, Mapping):
            options = dict(value)
            kind = choose(PROCESSES, options.pop("kind", None), f"{where}: table [disturbance]: {name}: kind")
            try:
                processes[name] = kind(**options)
            except TypeError as error:
                raise InputError(f"{where}: table [disturbance]: {name}: {error}") from None
        elif isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{where}: table [disturbance]: {name} must be a number or a table, got {value!r}")
    return processes


def _position(part: str, place: list[Any], key: str, where: str) -> int:
    if not part.isdigit() or int(part) >= len(place):
        raise InputError(f"{where}: [grid] {key}: {part!r} counts the {len(place)} entries of a list, from 0")
    return int(part)


def build(tables: Mapping[str, Any]) -> tuple[Plant, MHE]:
    """Return plant and estimator, built once for each configuration."""
    texts = (json.dumps(tables[name], default=str) for name in ("plant", "model", "estimator"))
    return _built(*texts, get_ident())


@lru_cache(maxsize=8)
def _built(plant: str, model: str, estimator: str, thread: int) -> tuple[Plant, MHE]:
    """Return what texts describe; a plant is run by one thread at a time, hence `thread`."""
    return _plant(json.loads(plant)), build_estimator(build_model(json.loads(model)), json.loads(estimator), "study")


def _plant(table: dict[str, Any]) -> Plant:
    if "fmu" not in table:
        return OdePlant(build_model({key: table[key] for key in LIBRARY if key in table}))
    inputs = table.get("inputs")
    options = {key: value for key, value in table.items() if key not in ("fmu", "truth", "inputs")}
    return FmuPlant(table["fmu"], inputs=list(inputs) if inputs is not None else None, **options)


def build_model(table: dict[str, Any]) -> Model:
    """Return the FMU or the model of the library that a table names."""
    if "fmu" in table:
        return FmuModel(table.pop("fmu"), **table)
    make = choose({name: getattr(library, name) for name in PLANTS}, table["model"], "study: model of the library")
    try:
        return make(**table.get("options", {}))
    except TypeError as error:
        raise InputError(f"study: model {table['model']!r}: {error}") from None
