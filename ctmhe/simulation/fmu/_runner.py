"""The instance of an FMU, started again and again, and what is kept to bring it back."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ctmhe.errors import FmuError, FmuUnsupportedError
from ctmhe.models.fmu.description import Description
from ctmhe.models.fmu.instance import Event, Instance, SavedState
from ctmhe.types import Array

log = logging.getLogger(__name__)

CROWD, CROWDED = 500, 1e-9  # so many events within so short a time (relative to t, or 1 s): they accumulate


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Where an engine was; `saved` is the inside of the FMU, None where it cannot tell and need not."""

    t: float
    x: Array
    inputs: Array
    saved: SavedState | None
    next_event: float
    positive: Array  # signs of the event indicators
    nominals: Array  # of the states


class Runner:
    """The instance of one FMU, started again and again, never two of them at a time.

    An FMU that can save its state is brought back to how it was just made: that is exact and saves loading it again.
    Others are made anew. So is one after an error, and one that does not take the way back.
    """

    def __init__(self, description: Description, folder: Path, kind: str):
        self._about, self._folder, self._kind = description, folder, kind
        self._instance: Instance | None = None
        self._made: SavedState | None = None
        self._reusable = description.kinds[kind].get_set_state

    @property
    def instance(self) -> Instance:
        """The running instance."""
        if self._instance is None:
            raise FmuError(f"{self._about.name} has not been started, or is closed: call start first")
        return self._instance

    def start(self, t: float, values: Mapping[str, float]) -> Event:
        """Initialize at `t` with start values by name."""
        if self._instance is not None and self._made is not None and not self._instance.failed:
            try:
                self._instance.load(self._made)
                return self._instance.initialize(t, values)
            except FmuError as error:  # a new instance either starts or says why not
                log.info("%s is made anew, it does not take the way back: %s", self._about.name, error)
        self.close()
        self._make()
        try:
            return self.instance.initialize(t, values)
        except BaseException:
            self.close()
            raise

    def _make(self) -> None:
        self._instance = Instance(self._about, self._folder, self._kind)
        if self._reusable:
            try:
                self._made = self._instance.save()
            except FmuError as error:
                log.info("%s is made anew at each start: %s", self._about.name, error)
                self._reusable = False
                self.close()
                self._instance = Instance(self._about, self._folder, self._kind)

    def stuck(self, what: str, reason: str, t: float) -> FmuError:
        """Return the error of a way that ended at `t` before its end."""
        name = self._about.name
        if self.instance.failed:
            advice = "The FMU takes no more calls after that: restore a checkpoint if it lets you, or start again"
        else:
            advice = f"The plant is at t = {t:.9g} now: restore a checkpoint, or start again with other values"
        return FmuError(f"{name}: {what}: {reason.removeprefix(f'{name}: ')}. {advice}")

    def save(self) -> SavedState | None:
        """Return the inside of the FMU, None when it does not offer that."""
        return self.instance.save() if self.instance.interface.get_set_state else None

    def close(self) -> None:
        """Free the instance; safe to call twice."""
        self._made = None
        if self._instance is not None:
            self._instance.close()
            self._instance = None


class Crowd:
    """Counts events that follow one another without time going on."""

    def __init__(self, t: float):
        self._since, self._count = t, 0

    def grows(self, t: float) -> bool:
        """Count an event at `t`; True when it is one too many."""
        if t - self._since > CROWDED * max(1.0, abs(t)):
            self._since, self._count = t, 0
        self._count += 1
        return self._count > CROWD


def cannot_return(about: Description) -> FmuUnsupportedError:
    """Return the error of an FMU that was asked to go back in time."""
    return FmuUnsupportedError(
        f"{about.name} cannot be brought back to an earlier time: it does not offer canGetAndSetFMUstate. Use "
        "triggers that are asked at monitoring times (no guards), or export it with that capability"
    )
