"""Everything of an estimator that changes: an immutable value that can be copied, branched and saved."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.priors import Piece
from ctmhe.types import Array, Trajectory, frozen

VERSION = 1


@dataclass(frozen=True, eq=False)
class State:
    """The estimator's memory at one moment.

    Attributes
    ----------
    t0 : float
        Start of estimation.
    t : float
        Time of the last estimate (`t0` before the first).
    start : array (nx + np,)
        Initial estimate chi_hat and parameters.
    x : array (nx,), p : array (np,)
        The last estimate.
    measurements, inputs : Log
        What is still needed, ordered in time.
    pieces : tuple of Piece
        The estimated trajectory (3.16) over the last horizon.
    window : Trajectory or None
        The last solution: warm start, and what `smooth` reads.
    active : tuple of arrays
        Bounds active there (x, w, y, p).
    solves : int
    """

    t0: float
    t: float
    start: Array
    x: Array
    p: Array
    measurements: Log
    inputs: Log
    pieces: tuple[Piece, ...] = ()
    window: Trajectory | None = None
    active: tuple[np.ndarray, ...] = ()
    solves: int = 0


def frozen_set(active: Any) -> np.ndarray:
    """Return a read-only copy of one part of an active set."""
    array = np.array(active, dtype=np.int8)
    array.flags.writeable = False
    return array


def save_state(state: State, path: str | Path, fingerprint: dict[str, Any]) -> None:
    """Write a state to a versioned `.npz` file (no pickle inside), in one atomic step."""
    arrays: dict[str, Array] = {"start": state.start, "x": state.x, "p": state.p}
    for name in ("measurements", "inputs"):
        arrays[f"{name}_t"], arrays[f"{name}_rows"] = getattr(state, name).arrays()
    trajectories = {f"piece{i}": piece.trajectory for i, piece in enumerate(state.pieces)}
    if state.window is not None:
        trajectories["window"] = state.window
        arrays |= {f"active{i}": part for i, part in enumerate(state.active)}
    for name, trajectory in trajectories.items():
        arrays |= {f"{name}_{field.name}": getattr(trajectory, field.name) for field in fields(Trajectory)}
    header = {
        "version": VERSION,
        "fingerprint": fingerprint,
        "t0": state.t0,
        "t": state.t,
        "solves": state.solves,
        "pieces": [[piece.start, piece.end] for piece in state.pieces],
        "window": state.window is not None,
    }
    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"state: cannot write {str(path)!r}: {error}") from error


def load_state(path: str | Path, fingerprint: dict[str, Any]) -> State:
    """Read a state; raise `InputError` when the file is damaged or was written by another configuration."""
    try:
        with np.load(path, allow_pickle=False) as data:
            header = json.loads(str(data["header"]))
            arrays = {name: data[name] for name in data.files if name != "header"}
    except FileNotFoundError:
        raise InputError(f"state: no file {str(path)!r}") from None
    except Exception as error:
        raise InputError(f"state: {str(path)!r} is not a saved state or is damaged ({error})") from error
    if header.get("version") != VERSION:
        raise InputError(f"state: {str(path)!r} has version {header.get('version')}, this library reads {VERSION}")
    for key, value in fingerprint.items():
        if header["fingerprint"].get(key) != value:
            raise InputError(
                f"state: {str(path)!r} was saved by an estimator with {key} = {header['fingerprint'].get(key)}, "
                f"this one has {value}"
            )

    def trajectory(name: str) -> Trajectory:
        return Trajectory(*(frozen(arrays[f"{name}_{field.name}"]) for field in fields(Trajectory)))

    def log(name: str) -> Log:
        return Log.of(arrays[f"{name}_t"], arrays[f"{name}_rows"], arrays[f"{name}_rows"].shape[1])

    window = trajectory("window") if header["window"] else None
    return State(
        t0=header["t0"],
        t=header["t"],
        start=frozen(arrays["start"]),
        x=frozen(arrays["x"]),
        p=frozen(arrays["p"]),
        measurements=log("measurements"),
        inputs=log("inputs"),
        pieces=tuple(Piece(a, b, trajectory(f"piece{i}")) for i, (a, b) in enumerate(header["pieces"])),
        window=window,
        active=tuple(frozen_set(arrays[f"active{i}"]) for i in range(4)) if window is not None else (),
        solves=header["solves"],
    )
