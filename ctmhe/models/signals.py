"""Named, unit-carrying groups of signals, and the conversion of user values into vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from math import isfinite
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array, frozen, names_of


@dataclass(frozen=True, eq=False)
class Signals:
    """One kind of signal of a model (`x`, `u`, `w`, `p` or `y`): names, units and typical sizes, in order.

    Attributes
    ----------
    kind : str
        `state`, `input`, `disturbance`, `parameter` or `output`; used in messages.
    names, units : tuple of str
    nominal : array (n,)
        Typical magnitude of each signal in its unit, used to scale the optimisation.
    """

    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Array

    @classmethod
    def of(
        cls,
        kind: str,
        names: str | Sequence[str],
        units: Mapping[str, str] | None = None,
        nominal: Mapping[str, float] | None = None,
    ) -> Signals:
        """Build from names and mappings that may also name signals of other kinds."""
        labels = names_of(names)
        if len(set(labels)) != len(labels):
            twice = sorted({name for name in labels if labels.count(name) > 1})
            raise InputError(f"{kind} names must differ, got {', '.join(twice)} more than once")
        sizes = np.array([float((nominal or {}).get(name, 1.0)) for name in labels])
        for name, size in zip(labels, sizes, strict=True):
            if not (np.isfinite(size) and size > 0):
                raise InputError(f"nominal of {kind} {name!r} must be finite and positive, got {size}")
        return cls(kind, labels, tuple((units or {}).get(name, "") for name in labels), frozen(sizes))

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self):
        return iter(self.names)

    def index(self, name: str) -> int:
        """Return the position of `name`, or raise an error that suggests the nearest name."""
        try:
            return self.names.index(name)
        except ValueError:
            near = get_close_matches(str(name), self.names, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise InputError(f"unknown {self.kind} {name!r}{hint} Known: {', '.join(self.names) or 'none'}") from None

    def complete(self, values: Any) -> bool:
        """Return whether what a `Measurement` or an `Input` holds is a vector (n,) already, without gaps."""
        if type(values) is not np.ndarray or values.shape != (len(self.names),):
            return False
        return isfinite(sum(values.tolist()))  # few numbers: quicker than any call into NumPy

    def vector(self, values: Any, what: str, *, missing: float | None = None, allow_nan: bool = False) -> Array:
        """Return `values` (array, scalar for one signal, or mapping by name) as a read-only vector (n,).

        `missing` fills names left out of a mapping; None makes them an error. Infinite values always raise, NaN unless
        `allow_nan`.
        """
        n = len(self.names)
        if isinstance(values, Mapping):
            vector = np.full(n, np.nan if missing is None else missing)
            given = set()
            for name, value in values.items():
                try:
                    i = self.index(name)
                except InputError as error:
                    raise InputError(f"{what}: {error}") from None
                try:
                    vector[i] = float(value)
                except (TypeError, ValueError):
                    raise InputError(f"{what}: {self.kind} {name!r} must be a number, got {value!r}") from None
                given.add(name)
            absent = [name for name in self.names if name not in given]
            if missing is None and absent:
                raise InputError(f"{what}: no value for {self.kind} {', '.join(absent)}")
        else:
            try:
                vector = np.array(values, dtype=np.float64)
            except (TypeError, ValueError):
                raise InputError(f"{what}: {self.kind} values must be numbers, got {values!r}") from None
            if vector.ndim == 2 and 1 in vector.shape:
                vector = vector.reshape(-1)
            vector = np.atleast_1d(vector)
            if vector.shape != (n,):
                raise InputError(
                    f"{what}: expected {n} {self.kind} value{'s' * (n != 1)} ({', '.join(self.names) or 'none'}), "
                    f"got shape {vector.shape}"
                )
        bad = np.isinf(vector) | (np.isnan(vector) & (not allow_nan))
        if bad.any():
            culprit = int(np.flatnonzero(bad)[0])
            hint = "; use NaN for a missing sensor" if allow_nan else ""
            raise InputError(f"{what}: {self.kind} {self.names[culprit]!r} is {vector[culprit]}, not finite{hint}")
        vector.flags.writeable = False
        return vector
