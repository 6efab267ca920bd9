"""A recorded experiment from a TOML file: FMU, log, estimator and trigger, for the command line."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from ctmhe.data.log import MeasurementLog
from ctmhe.errors import InputError
from ctmhe.estimators.mhe import MHE
from ctmhe.models.fmu import FmuModel
from ctmhe.simulation import Everything, Run, SingleSample, WholeSignal, replay
from ctmhe.simulation.replay import check_units
from ctmhe.transcription import CVODES, RK4
from ctmhe.triggers import Trigger
from ctmhe.triggers.loading import build_trigger
from ctmhe.types import Bounds, DiscountedCost

TABLES: dict[str, tuple[str, ...]] = {
    "model": (
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
    ),
    "log": ("time", "time_unit", "outputs", "inputs", "units"),
    "estimator": ("horizon", "interval", "integrator", "cost", "bounds", "hold", "hold_limit", "input_hold", "solver"),
    "guess": (),
    "trigger": (),
    "channel": ("kind",),
}
INTEGRATORS = {"RK4": RK4, "CVODES": CVODES}
CHANNELS = {"WholeSignal": WholeSignal, "SingleSample": SingleSample, "Everything": Everything}


@dataclass(frozen=True, eq=False)
class Case:
    """A recorded experiment, ready to run."""

    model: FmuModel
    mhe: MHE
    log: MeasurementLog
    guess: Mapping[str, float]
    p: Mapping[str, float] | None
    trigger: Trigger
    channel: Any

    @classmethod
    def load(cls, *, fmu: Path, log: Path, config: Path, trigger: Trigger | None = None) -> Case:
        """Read a case.

        Parameters
        ----------
        fmu, log, config : Path
            The FMU, the CSV file and the TOML file with the tables model, log, estimator, guess, trigger, channel.
        trigger : Trigger, optional
            In place of the configuration's.

        Raises
        ------
        InputError
            For a file that cannot be read, an unknown key (with the nearest known one), a missing value.
        """
        table = read_toml(config)
        for name in table:
            _check_key(name, tuple(TABLES), str(config))
        for name, known in TABLES.items():
            for key in table.get(name, {}):
                if known:
                    _check_key(key, known, f"{config}: table [{name}]")
        model = FmuModel(fmu, **table.get("model", {}))
        mhe = build_estimator(model, table.get("estimator", {}), str(config))
        given = table.get("log", {})
        columns = {"outputs": model.y.names, "inputs": model.u.names} | given
        guess = dict(zip(model.x.names, model.x_start, strict=True)) | _numbers(table.get("guess", {}), model)
        p = {name: guess.pop(name) for name in list(guess) if name in model.p.names}
        policy = trigger or build_trigger(table.get("trigger", {"name": "MaxInterval", "seconds": mhe.horizon / 4}))
        channel = _choose(CHANNELS, table["channel"].get("kind"), "channel kind")() if "channel" in table else None
        recorded = MeasurementLog.from_csv(log, **columns)
        check_units(recorded, model)
        return cls(model, mhe, recorded, guess, p or None, policy, channel)

    def run(self, *, progress: bool = False) -> Run:
        """Replay the log through trigger and estimator."""
        return replay(
            self.log,
            self.mhe,
            trigger=self.trigger,
            guess=self.guess,
            p=self.p,
            channel=self.channel,
            progress=progress,
        )


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raise `InputError` with the line where it is not valid."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"no configuration file {str(path)!r}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not valid TOML: {error}") from None


def build_estimator(model: FmuModel, table: Mapping[str, Any], where: str) -> MHE:
    """Return the estimator that the table [estimator] describes."""
    options = dict(table)
    for key in ("horizon",) if model.step else ("horizon", "interval"):
        if key not in options:
            raise InputError(f"{where}: table [estimator] needs {key} (seconds)")
    cost = dict(options.pop("cost", {}))
    bounds = {key: _box(value) for key, value in options.pop("bounds", {}).items()}
    try:
        if not model.step:  # a step map has no integrator
            integrator = dict(options.pop("integrator", {"kind": "RK4", "step": options["interval"] / 5}))
            kind = _choose(INTEGRATORS, integrator.pop("kind", None), "integrator kind")
            options["integrator"] = kind(**integrator)
        return MHE(model, cost=DiscountedCost(**cost), bounds=Bounds(**bounds), **options)
    except TypeError as error:
        raise InputError(f"{where}: table [estimator]: {error}") from None


def _box(value: Any) -> Any:
    return {name: tuple(pair) for name, pair in value.items()} if isinstance(value, Mapping) else tuple(value)


def _numbers(table: Mapping[str, Any], model: FmuModel) -> dict[str, float]:
    known = (*model.x.names, *model.p.names)
    for name, value in table.items():
        _check_key(name, known, "table [guess]")
        if not isinstance(value, (int, float)):
            raise InputError(f"table [guess]: {name} must be a number, got {value!r}")
    return {name: float(value) for name, value in table.items()}


def _choose(options: Mapping[str, Any], name: Any, what: str) -> Any:
    if name not in options:
        raise InputError(f"{what}: expected one of {', '.join(options)}, got {name!r}")
    return options[name]


def _check_key(key: str, known: tuple[str, ...], where: str) -> None:
    if key not in known:
        near = get_close_matches(key, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else "."
        raise InputError(f"{where}: unknown key {key!r}{hint} Known: {', '.join(known)}")
