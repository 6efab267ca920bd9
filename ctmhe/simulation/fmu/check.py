"""What an FMU is good for: every check, one after the other, as a table with a verdict."""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.errors import CtmheError, FmuError, FmuEventError, FmuKindError, FmuParameterError
from ctmhe.models.fmu import FmuModel
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.choice import check_supported, probe
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, platform_folder
from ctmhe.models.fmu.reading import read_description
from ctmhe.simulation.fmu.plant import FmuPlant

UNUSABLE, PLANT, ESTIMATOR, PARAMETERS = "unusable", "plant only", "estimator", "estimator with parameters"
TRIED = 50  # parameters that are tried one by one when they cannot be estimated together
WIDTH = 100
TITLES = {MODEL_EXCHANGE: "model exchange", CO_SIMULATION: "co-simulation"}


@dataclass(frozen=True)
class Row:
    """One check: its name, what came of it (`ok`, `note`, `warning`, `refused`), and details."""

    check: str
    result: str
    detail: str


@dataclass(frozen=True)
class Checkup:
    """What `check_fmu` found.

    Attributes
    ----------
    path : Path
    rows : tuple of Row
        In the order of the checks; those behind one that makes them pointless are left out.
    verdict : str
        `unusable`, `plant only`, `estimator` (of states), `estimator with parameters`.
    error : FmuError or None
        Why it is no estimator.
    parameters : tuple of str
        That can be estimated.
    """

    path: Path
    rows: tuple[Row, ...]
    verdict: str
    error: CtmheError | None
    parameters: tuple[str, ...]

    def __str__(self) -> str:
        width = max(len(row.check) for row in self.rows)
        lines = [self.path.name]
        for row in self.rows:
            head = f"  {row.check:<{width}}  {row.result:<7}  "
            lines += textwrap.wrap(row.detail, WIDTH, initial_indent=head, subsequent_indent=" " * len(head)) or [head]
        return "\n".join([*lines, f"verdict: {self.verdict}"])


def check_fmu(path: str | Path) -> Checkup:
    """Try an FMU as plant and as an estimator's model.

    Its binary runs in processes of its own first; nothing is written but to a temporary folder. Never raises for what
    is wrong with the FMU.

    Parameters
    ----------
    path : str or Path
        The .fmu file.
    """
    return _Examination(Path(path)).run()


class _Examination:
    def __init__(self, path: Path):
        self.path = path
        self.rows: list[Row] = []
        self.parameters: tuple[str, ...] = ()
        self.error: CtmheError | None = None

    def run(self) -> Checkup:
        verdict = self._verdict()
        return Checkup(self.path, tuple(self.rows), verdict, self.error, self.parameters)

    def _verdict(self) -> str:
        about = self._opened()
        if about is None:
            return UNUSABLE
        plant = self._plant(about)
        estimator = self._estimator(about)
        return estimator or (PLANT if plant else UNUSABLE)

    def _row(self, check: str, result: str, detail: str) -> None:
        self.rows.append(Row(check, result, detail))

    def _refused(self, check: str, error: CtmheError) -> None:
        self._row(check, "refused", f"{type(error).__name__}: {error}")
        self.error = error

    def _opened(self) -> Description | None:
        """Archive, description, kinds, and the binary in a process of its own."""
        try:
            archive = Unpacked(self.path)
        except FmuError as error:
            self._refused("archive", error)
            return None
        try:
            files = [file for file in archive.folder.rglob("*") if file.is_file()]
            size = sum(file.stat().st_size for file in files)
            self._row("archive", "ok", f"{len(files)} files, {size / 1e6:.2g} MB, all checksums right")
            try:
                about = read_description(archive.folder)
            except FmuError as error:
                self._refused("description", error)
                return None
            self._row("description", "ok", f"{about.name}, FMI {about.version}, by {about.tool or 'an unnamed tool'}")
            kinds = ", ".join(TITLES[kind] for kind in about.kinds)
            self._row("kinds", "ok" if kinds else "refused", kinds or "neither model exchange nor co-simulation")
            for kind in about.kinds:
                try:
                    probe(about, archive.folder, kind)
                except FmuError as error:
                    self._refused("binary", error)
                    return None
            where = f"for {platform_folder(about.major)}; loaded and initialized in a process of its own"
            self._row("binary", "ok", where)
            return about if kinds else None
        finally:
            archive.close()

    def _plant(self, about: Description) -> bool:
        """Make a plant and take a step."""
        step = _step(about)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                plant = FmuPlant(self.path, isolated=True)
            try:
                plant.start(about.start_time or 0.0, None)
                w = np.zeros(len(plant.w))
                plant.advance((about.start_time or 0.0) + step, plant.u_start, plant.u_start, w)
                plant.output(plant.u_start, w)
                how = plant.integrator if plant.kind == CO_SIMULATION else f"{TITLES[plant.kind]}, {plant.integrator}"
                self._row("plant", "ok", f"runs for {step:g} s by {how}")
            finally:
                plant.close()
        except CtmheError as error:
            self._row("plant", "refused", f"{type(error).__name__}: {error}")
            return False
        return True

    def _estimator(self, about: Description) -> str | None:
        """Make a model of it, without parameters and with those that can be estimated."""
        try:
            check_supported(about)
        except FmuError as error:
            self._refused("variables", error)
            return None
        tunable = [v.name for v in about.parameters if v.variability == "tunable"]
        groups = {"state": about.states, "input": about.inputs, "output": about.outputs, "tunable parameter": tunable}
        counts = ", ".join(f"{len(group)} {name}{'s' * (len(group) != 1)}" for name, group in groups.items())
        self._row("variables", "note" if about.remarks else "ok", "; ".join([f"{counts}, all scalars", *about.remarks]))
        arguments: dict[str, Any] = {}
        if MODEL_EXCHANGE not in about.kinds:
            arguments["step"] = about.kinds[CO_SIMULATION].fixed_step or _step(about)
        if not about.outputs and about.states:
            arguments["outputs"] = [state.name for state in about.states]
        frozen = False
        try:
            model, said = self._model(arguments)
        except FmuEventError as error:
            self._refused("events", error)
            frozen = True
            try:
                model, said = self._model(arguments | {"allow_frozen_events": True})
            except CtmheError as second:
                self._row("derivatives", "refused", f"{type(second).__name__}: {second}")
                return None
        except CtmheError as error:
            self._refused("model" if isinstance(error, FmuKindError) else "derivatives", error)
            return None
        if not frozen:
            self._row("events", *_step_events(about))
        how = "directional derivatives" if model.exact_derivatives else "central differences"
        good = f"values as in fmpy, Jacobians as their differences ({how})"
        told = [text.removeprefix(f"{about.name}: ") for text in said]
        told = [text for text in told if text not in about.remarks]
        self._row("derivatives", "warning" if told else "ok", "; ".join(told) or good)
        limits = "one per process: no threads" if model.single_instance else "any number"
        self._row("instances", "note" if model.single_instance else "ok", limits)
        self._parameters(tunable, arguments | ({"allow_frozen_events": True} if frozen else {}))
        if frozen:
            return None
        return PARAMETERS if self.parameters else ESTIMATOR

    def _model(self, arguments: dict[str, Any]) -> tuple[FmuModel, tuple[str, ...]]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = FmuModel(self.path, **arguments)
        model.close()
        return model, model.warnings

    def _parameters(self, tunable: list[str], arguments: dict[str, Any]) -> None:
        if not tunable:
            self._row("parameters", "note", "none is tunable: none can be estimated")
            return
        refused: FmuParameterError | None = None
        good: list[str] = []
        for names in self._groups(tunable):
            try:
                self._model(arguments | {"parameters": names})
                good += names
                if len(names) > 1:
                    break
            except FmuParameterError as error:
                refused = error
            except CtmheError as error:
                self._row("parameters", "refused", f"{type(error).__name__}: {error}")
                return
        self.parameters = tuple(good)
        listed = textwrap.shorten(", ".join(good), 300, placeholder=" ...")
        if good:
            result = "ok" if len(good) == len(tunable) else "warning"
            self._row("parameters", result, f"{len(good)} of {len(tunable)} can be estimated: {listed}")
        else:
            self._row("parameters", "refused", f"{type(refused).__name__}: {refused}")

    @staticmethod
    def _groups(names: list[str]) -> Iterator[list[str]]:
        """Yield all together, then one by one."""
        yield names
        if len(names) > 1:
            yield from ([name] for name in names[:TRIED])


def _step_events(about: Description) -> tuple[str, str]:
    """Return result and detail for an FMU without state and time events."""
    if MODEL_EXCHANGE not in about.kinds:
        return "ok", "handled by the FMU"
    if about.kinds[MODEL_EXCHANGE].completed_step:
        return "note", (
            "none declared; it wants to hear of integration steps (completedIntegratorStep): an estimator does not "
            "tell it, a plant does"
        )
    return "ok", "none"


def _step(about: Description) -> float:
    """Return a length of time that means something to the FMU, in seconds."""
    span = (about.stop_time or 0.0) - (about.start_time or 0.0)
    return about.step or (span / 100 if span > 0 else 0.01)
