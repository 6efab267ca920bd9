"""Everything of an estimator that changes: an immutable value that can be copied, branched and saved."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.certificates.guarantee import Track
from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.transcription.solved import Layout, Solved
from ctmhe.types import Array, frozen, made

VERSION = 3
LOGS = ("measurements", "inputs", "path")


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
    path : Log
        The estimated trajectory (3.16) over the last horizon, as rows of `trajectories.path_rows`.
    since : float
        From when on the last estimate defines it.
    window : Solved or None
        The last solution: warm start, and what `smooth` reads.
    solves : int
    prepared : object or None
        Says that the estimator has prepared the next estimate from this state; of no influence on its result.
    memory : mapping name -> Log
        What the prior remembers.
    track : Track or None
        What the next estimate's guaranteed bound needs of the past.
    doubts : tuple of (time, reason)
        When data were not what the guarantee assumes.
    """

    t0: float
    t: float
    start: Array
    x: Array
    p: Array
    measurements: Log
    inputs: Log
    path: Log
    since: float
    window: Solved | None = None
    solves: int = 0
    prepared: object | None = None
    memory: Mapping[str, Log] = field(default_factory=dict)
    track: Track | None = None
    doubts: tuple[tuple[float, str], ...] = ()

    def knowing(self, measurements: Log, inputs: Log) -> State:
        """Return the state with other logs."""
        return made(State, self.__dict__ | {"measurements": measurements, "inputs": inputs})


def save_state(state: State, path: str | Path, fingerprint: dict[str, Any]) -> None:
    """Write a state to a versioned `.npz` file (no pickle inside), in one atomic step."""
    arrays: dict[str, Array] = {"start": state.start, "x": state.x, "p": state.p}
    for name in LOGS:
        arrays[f"{name}_t"], arrays[f"{name}_rows"] = getattr(state, name).arrays()
    for name, log in state.memory.items():
        arrays[f"memory_{name}_t"], arrays[f"memory_{name}_rows"] = log.arrays()
    if state.window is not None:
        arrays |= {"window_values": state.window.values, "window_active": state.window.active}
    header = {
        "version": VERSION,
        "fingerprint": fingerprint,
        "t0": state.t0,
        "t": state.t,
        "since": state.since,
        "solves": state.solves,
        "slots": None if state.window is None else state.window.n,
        "track": None if state.track is None else asdict(state.track),
        "doubts": state.doubts,
        "memory": list(state.memory),
    }
    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        with temporary.open("wb") as file:
            np.savez(file, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"state: cannot write {str(path)!r}: {error}") from error


def load_state(path: str | Path, fingerprint: dict[str, Any], layout: Layout) -> State:
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
    window = None
    if header["slots"] is not None:
        window = Solved.copied(layout, header["slots"], arrays["window_values"], arrays["window_active"])
    track = header.get("track")
    if track is not None:
        track = Track(**track | {name: tuple(track[name]) for name in ("ends", "levels")})
    logs = {name: _log(arrays, name) for name in LOGS}
    return State(
        t0=header["t0"],
        t=header["t"],
        start=frozen(arrays["start"]),
        x=frozen(arrays["x"]),
        p=frozen(arrays["p"]),
        since=header["since"],
        window=window,
        solves=header["solves"],
        memory={name: _log(arrays, f"memory_{name}") for name in header["memory"]},
        track=track,
        doubts=tuple((t, reason) for t, reason in header.get("doubts", ())),
        **logs,
    )


def _log(arrays: Mapping[str, Array], name: str) -> Log:
    rows = arrays[f"{name}_rows"]
    return Log.of(arrays[f"{name}_t"], rows, rows.shape[1])
