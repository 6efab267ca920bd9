"""Trajectories of runs as Zarr stores, one zip file a run.

zarr-python takes milliseconds an array, and a run has thirty of them; so the few lines of JSON and the chunk of every
array are written here, after the Zarr specification, version 3 (zarr-specs.readthedocs.io), without compression. Any
Zarr reader opens the files: `xarray.open_zarr(zarr.storage.ZipStore(path))`.
"""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.errors import InputError, MissingExtra
from ctmhe.simulation.run import FORMAT, Run

if TYPE_CHECKING:
    import xarray as xr

KINDS = {"f": ("float64", "<f8", 0.0), "i": ("int64", "<i8", 0), "b": ("bool", "|b1", False)}
BYTES = {"name": "bytes", "configuration": {"endian": "little"}}


def write_trajectory(run: Run, path: Path) -> None:
    """Write a run's dataset to a zip file; see `store.replacing` for writing in one step."""
    data = run.dataset
    beside = [str(name) for name in data.coords if name not in data.dims]
    attributes = {**data.attrs, "coordinates": " ".join(beside)}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("zarr.json", _json({"node_type": "group", "attributes": attributes}))
        for name, variable in data.variables.items():
            about, chunk = _encoded(variable)
            archive.writestr(f"{name}/zarr.json", _json({"node_type": "array", **about}))
            if chunk is not None:
                archive.writestr("/".join([f"{name}/c", *"0" * variable.ndim]), chunk)


def read_trajectory(path: Path) -> Run:
    """Read a run that `write_trajectory` wrote.

    Raises
    ------
    InputError
        If there is no such file, or it is not a run.
    MissingExtra
        When zarr is not installed.
    """
    if not path.is_file():
        raise InputError(f"study: there is no trajectory {path.name}; run the study with trajectories=True")
    if not zipfile.is_zipfile(path):
        raise InputError(f"study: {path.name} cannot be read as Zarr: it is no zip file")
    try:
        from zarr.storage import ZipStore
    except ImportError:
        raise MissingExtra("zarr", "study", "reading trajectories") from None
    import xarray as xr

    try:
        with ZipStore(path, mode="r") as store:
            data = xr.open_zarr(store, consolidated=False, decode_times=False, chunks=None).load()
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"study: {path.name} cannot be read as Zarr: {error}") from error
    if data.attrs.get("format") != FORMAT:
        raise InputError(f"study: {path.name} has format {data.attrs.get('format')!r}, this version reads {FORMAT!r}")
    for name, variable in data.variables.items():
        if variable.dtype.kind not in KINDS:
            data[name] = variable.astype(object)
    for variable in data.variables.values():
        variable.encoding = {}
    return Run(data)


def _encoded(variable: xr.Variable) -> tuple[dict[str, Any], bytes | None]:
    """Return the description and the single chunk of an array, None for an array without entries."""
    values = np.asarray(variable.to_numpy())
    if values.dtype.kind in KINDS:
        name, kind, fill = KINDS[values.dtype.kind]
        codec, chunk = BYTES, np.ascontiguousarray(values, dtype=kind).tobytes()
    else:
        name, fill, codec = "string", "", {"name": "vlen-utf8"}
        texts = [str(text).encode() for text in values.ravel()]
        chunk = struct.pack("<I", len(texts)) + b"".join(struct.pack("<I", len(text)) + text for text in texts)
    about = {
        "shape": values.shape,
        "data_type": name,
        "chunk_grid": {
            "name": "regular",
            "configuration": {"chunk_shape": [max(1, length) for length in values.shape]},
        },
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": [codec],
        "attributes": variable.attrs,
        "dimension_names": variable.dims,
    }
    return about, chunk if values.size else None


def _json(content: dict[str, Any]) -> str:
    return json.dumps({"zarr_format": 3, **content}, default=lambda value: np.asarray(value).tolist())
