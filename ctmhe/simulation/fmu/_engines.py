"""What a plant asks of a running FMU, and how such an engine is built, here or in another process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ctmhe.models.fmu.description import MODEL_EXCHANGE, Description, Variable
from ctmhe.simulation.fmu._cosimulation import CoSimulation
from ctmhe.simulation.fmu._exchange import ModelExchange
from ctmhe.types import Array


class Engine(Protocol):
    """A running FMU: `inputs` are values of the variables given when it was made."""

    method: str
    t: float

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        """Begin at `t` with start values by name; `x` holds the states among them."""
        ...

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        """Go to `t`, inputs linear from `before` to `after`, `push` (nx,) added to the derivatives."""
        ...

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        """Return variables now, with these inputs."""
        ...

    def checkpoint(self) -> Any:
        """Return where it is, for `restore`."""
        ...

    def restore(self, checkpoint: Any) -> None:
        """Go back to a checkpoint of this run, exactly."""
        ...

    def close(self) -> None:
        """Free the FMU."""
        ...


@dataclass(frozen=True)
class Setup:
    """All that it takes to run an unpacked FMU; it can be pickled. `step` is of co-simulation, `rtol`, `atol` not."""

    kind: str
    description: Description
    folder: Path
    inputs: tuple[Variable, ...]
    step: float | None
    rtol: float
    atol: float

    def engine(self) -> Engine:
        """Return the engine, not started."""
        if self.kind == MODEL_EXCHANGE:
            return ModelExchange(self.description, self.folder, self.inputs, self.rtol, self.atol)
        return CoSimulation(self.description, self.folder, self.inputs, self.step)
