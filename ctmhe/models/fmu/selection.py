"""Variables chosen by name, pattern or property."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Protocol, TypeVar

from ctmhe.errors import InputError

LISTED = 12  # names that a message lists; the rest are counted
COMPARED = 5_000  # names that are compared for the nearest: closeness is slow


class Selectable(Protocol):
    """What a variable needs to be chosen."""

    @property
    def name(self) -> str:
        """Its name, compared as it is."""
        ...

    @property
    def causality(self) -> str:
        """As FMI calls it: `input`, `output`, `parameter`, `local`, ..."""
        ...

    @property
    def variability(self) -> str:
        """As FMI calls it: `continuous`, `tunable`, `fixed`, ..."""
        ...


V = TypeVar("V", bound=Selectable)


def select(role: str, wanted: Iterable[str] | str | None, known: Sequence[V]) -> tuple[V, ...]:
    """Return those of `known` that `wanted` says; see `Description.select`."""
    if wanted is None:
        return tuple(known)
    by_name = {variable.name: variable for variable in known}
    entries = (wanted,) if isinstance(wanted, str) else tuple(wanted)
    named: set[str] = set()
    chosen: dict[str, V] = {}
    for entry in entries:
        if not isinstance(entry, str):
            raise InputError(f"{role}: expected a name, got {entry!r}")
        if entry in named:
            raise InputError(f"{role} {entry!r} is named twice; name it once")
        named.add(entry)
        found = [by_name[entry]] if entry in by_name else _matching(entry, known)
        if not found:
            raise _unknown(role, entry, by_name)
        chosen.update((variable.name, variable) for variable in found)
    return tuple(chosen.values())


def _matching(entry: str, known: Sequence[V]) -> list[V]:
    key, _, value = entry.partition(":")
    if key in {"causality", "variability"}:
        return [variable for variable in known if getattr(variable, key) == value]
    if not {"*", "?"} & set(entry):
        return []
    parts = (".*" if c == "*" else "." if c == "?" else re.escape(c) for c in re.sub(r"\*+", "*", entry))
    pattern = re.compile("".join(parts), re.DOTALL)
    return [variable for variable in known if pattern.fullmatch(variable.name)]


def _unknown(role: str, entry: str, names: Iterable[str]) -> InputError:
    known = list(names)
    near = get_close_matches(entry, known[:COMPARED], n=3)
    hint = f"; did you mean {' or '.join(repr(name) for name in near)}?" if near else "."
    more = f" and {len(known) - LISTED} more" if len(known) > LISTED else ""
    return InputError(f"unknown {role} {entry!r}{hint} Known: {', '.join(known[:LISTED]) or 'none'}{more}")
