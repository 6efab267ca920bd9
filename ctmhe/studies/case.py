"""A recorded experiment from a TOML file: FMU, log, estimator and trigger, for the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctmhe.data.log import MeasurementLog
from ctmhe.estimators.mhe import MHE
from ctmhe.models.fmu import FmuModel
from ctmhe.simulation import Run, replay
from ctmhe.simulation.replay import check_units
from ctmhe.studies.tables import (
    ESTIMATOR,
    MODEL,
    build_channel,
    build_estimator,
    build_guess,
    check_keys,
    read_toml,
    table_of,
)
from ctmhe.triggers import Trigger
from ctmhe.triggers.loading import build_trigger

TABLES: dict[str, tuple[str, ...]] = {
    "model": MODEL,
    "log": ("time", "time_unit", "outputs", "inputs", "units"),
    "estimator": ESTIMATOR,
    "guess": (),  # names of states and parameters
    "trigger": (),
    "channel": ("kind",),
}


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
        table, where = read_toml(config), str(config)
        check_keys(table, TABLES, where)
        for name, known in TABLES.items():
            check_keys(table_of(table, name, where) if known else (), known, f"{where}: table [{name}]")
        model = FmuModel(fmu, **table.get("model", {}))
        mhe = build_estimator(model, table.get("estimator", {}), where)
        columns = {"outputs": model.y.names, "inputs": model.u.names} | table.get("log", {})
        guess, p = build_guess(table_of(table, "guess", where), model, where)
        policy = trigger or build_trigger(table.get("trigger", {"name": "MaxInterval", "seconds": mhe.horizon / 4}))
        channel = build_channel(table["channel"], where) if "channel" in table else None
        recorded = MeasurementLog.from_csv(log, **columns)
        check_units(recorded, model)
        return cls(model, mhe, recorded, guess, p, policy, channel)

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
