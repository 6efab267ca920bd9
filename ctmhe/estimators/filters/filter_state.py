"""The state of a recursive filter: an immutable value that can be kept, branched and saved."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.types import Array, Trajectory, frozen

VERSION = 1
LOGS = ("measurements", "inputs")


@dataclass(frozen=True, eq=False)
class Belief:
    """What a recursion knows at an instant.

    Attributes
    ----------
    z : array (m,)
        Mean of (x, estimated p), and behind them of the disturbance of the current cell where that is held.
    P : array (m, m)
        Its covariance.
    memory : mapping name -> array
        What a rule remembers besides.
    """

    z: Array
    P: Array
    memory: Mapping[str, Array] = field(default_factory=dict)

    def covariance(self, n: int) -> Array:
        """Return the covariance (n, n) of the first entries; infinite where a rule has lost it."""
        return frozen(np.diag(np.full(n, np.inf)) if "unbounded" in self.memory else self.P[:n, :n])


@dataclass(frozen=True, eq=False)
class FilterState:
    """A filter's memory at one moment.

    Attributes
    ----------
    t0, t : float
        Start of estimation, and time of the last estimate, seconds.
    x : array (nx,), p : array (np,)
        The last estimate.
    belief : Belief
        At `t`, the measurements of `t` included.
    cell : int
        Number of the disturbance cell that `belief` speaks of.
    used : array (ny,)
        What the sensors said at `t`, NaN where they have not spoken: no value counts twice.
    measurements, inputs : Log
        What is not used yet, and the inputs from the last one at or before `t` on.
    cost : float
        Discounted sum of squared innovations, each weighted by its inverse covariance.
    solves : int
    """

    t0: float
    t: float
    x: Array
    p: Array
    belief: Belief
    cell: int
    used: Array
    measurements: Log
    inputs: Log
    cost: float = 0.0
    solves: int = 0


@dataclass(frozen=True, eq=False)
class Filtered:
    """What a filter's estimate keeps of its "window": the instant itself."""

    trajectory: Trajectory
    prior: Array

    def part(self, name: str) -> Array:
        """Return `prior`, the prediction (nx + np,) before the measurements of the instant."""
        if name != "prior":
            raise InputError(f"a filter's estimate has no {name!r}: only an MHE solves windows with bounds")
        return self.prior


def save_filter_state(state: FilterState, path: str | Path, fingerprint: dict[str, Any]) -> None:
    """Write a state to a versioned `.npz` file (no pickle inside), in one atomic step."""
    arrays: dict[str, Array] = {"x": state.x, "p": state.p, "used": state.used, "z": state.belief.z}
    arrays |= {"P": state.belief.P} | {f"memory_{name}": value for name, value in state.belief.memory.items()}
    for name in LOGS:
        arrays[f"{name}_t"], arrays[f"{name}_rows"] = getattr(state, name).arrays()
    numbers = {name: getattr(state, name) for name in ("t0", "t", "cell", "cost", "solves")}
    header = {"filter": VERSION, "fingerprint": fingerprint, **numbers}
    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"state: cannot write {str(path)!r}: {error}") from error


def load_filter_state(path: str | Path, fingerprint: dict[str, Any]) -> FilterState:
    """Read a state; raise `InputError` when the file is damaged or was written by another configuration."""
    try:
        with np.load(path, allow_pickle=False) as data:
            header = json.loads(str(data["header"]))
            arrays = {name: frozen(data[name]) for name in data.files if name != "header"}
    except FileNotFoundError:
        raise InputError(f"state: no file {str(path)!r}") from None
    except Exception as error:
        raise InputError(f"state: {str(path)!r} is not a saved state or is damaged ({error})") from error
    if header.get("filter") != VERSION:
        raise InputError(f"state: {str(path)!r} is no filter's state of version {VERSION}")
    for key, value in fingerprint.items():
        if header["fingerprint"].get(key) != value:
            raise InputError(
                f"state: {str(path)!r} was saved by a filter with {key} = {header['fingerprint'].get(key)}, this one "
                f"has {value}"
            )
    memory = {name.removeprefix("memory_"): array for name, array in arrays.items() if name.startswith("memory_")}
    logs = {name: Log.of(arrays[f"{name}_t"], rows := arrays[f"{name}_rows"], rows.shape[1]) for name in LOGS}
    numbers = {name: header[name] for name in ("t0", "t", "cell", "cost", "solves")}
    belief = Belief(arrays["z"], arrays["P"], memory)
    return FilterState(x=arrays["x"], p=arrays["p"], belief=belief, used=arrays["used"], **logs, **numbers)
