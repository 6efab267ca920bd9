"""What an FMU says of itself, as a screen for a person."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.description import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    Description,
    Interface,
    Variable,
    platform_folder,
)
from ctmhe.models.fmu.reading import read_description

WIDTH = 110
LONGEST_NAME = 44  # a longer one gets a line of its own
KINDS = {MODEL_EXCHANGE: "model exchange", CO_SIMULATION: "co-simulation"}
FLAGS = {
    "directional_derivatives": "directional derivatives",
    "get_set_state": "get/set state",
    "event_mode": "event mode",
    "early_return": "early return",
    "single_instance": "one instance a process",
    "needs_tool": "needs the tool that made it",
}


def describe(path: str | Path) -> str:
    """Return what an FMU is and what it offers, as text of at most 110 columns (longer names excepted).

    Parameters
    ----------
    path : str or Path
        The .fmu file.

    Raises
    ------
    FmuError
        If it cannot be read: `FmuArchiveError`, `FmuVersionError`.
    """
    archive = Unpacked(path)
    try:
        about = read_description(archive.folder)
    finally:
        archive.close()
    lines = [_cut(f"{about.name}: FMI {about.version}, made by {about.tool or 'an unnamed tool'}")]
    lines += [_cut(about.description)] if about.description else []
    lines.append("")
    facts = list(_facts(about))
    width = max(len(key) for key, _ in facts)
    lines += [line for key, text in facts for line in _wrapped(f"{key:<{width}}  ", text)]
    groups = {
        "states": about.states,
        "inputs": about.inputs,
        "outputs": about.outputs,
        "tunable parameters": tuple(v for v in about.parameters if v.variability == "tunable"),
        "fixed parameters": tuple(v for v in about.parameters if v.variability == "fixed"),
    }
    lines += _tables(groups)
    if about.unsupported:
        lines += ["", f"not supported ({len(about.unsupported)})"]
        lines += [_cut(f"  {name}: {reason}") for name, reason in about.unsupported.items()]
    return "\n".join(line.rstrip() for line in lines)


def _facts(about: Description) -> Iterator[tuple[str, str]]:
    for kind, title in KINDS.items():
        if kind in about.kinds:
            yield title, _capabilities(about.kinds[kind], kind)
    if not about.kinds:
        yield "kinds", "neither model exchange nor co-simulation"
    count = about.event_indicators
    yield "events", f"{count} event indicator{'s' * (count != 1)}" if count else "no event indicators"
    silent = [name for name, known in about.dependencies.items() if known is None]
    if silent:
        yield "dependencies", f"not declared for {', '.join(silent[:5])}{' and more' * (len(silent) > 5)}"
    here = platform_folder(about.major)
    if here in about.platforms:
        shown = [f"{name} (this platform)" if name == here else name for name in about.platforms]
        yield "binaries", ", ".join(shown)
    else:
        remedy = "; compile it: ctmhe fmu build FILE" if about.sources else ""
        yield "binaries", f"{', '.join(about.platforms) or 'none'}; none for this platform ({here}){remedy}"
    files = dict.fromkeys(name for sets in about.sources.values() for each in sets for name in each.files)
    yield "sources", ", ".join(files) or "none"
    yield "experiment", _experiment(about)


def _capabilities(interface: Interface, kind: str) -> str:
    offers = [label for field, label in FLAGS.items() if getattr(interface, field)]
    if not interface.directional_derivatives:
        offers.insert(0, "no directional derivatives (differences are taken)")
    if kind == CO_SIMULATION:
        offers.append("steps of any length" if interface.variable_step else "steps of one length")
        if interface.fixed_step is not None:
            offers.append(f"internal step {interface.fixed_step:g} s")
    elif interface.completed_step:
        offers.append("wants to be told of completed steps")
    return ", ".join(offers)


def _experiment(about: Description) -> str:
    parts = []
    if about.stop_time is not None:
        parts.append(f"{about.start_time or 0.0:g} to {about.stop_time:g} s")
    elif about.start_time is not None:
        parts.append(f"from {about.start_time:g} s")
    parts += [f"step {about.step:g} s"] if about.step is not None else []
    parts += [f"tolerance {about.tolerance:g}"] if about.tolerance is not None else []
    return ", ".join(parts) or "none"


def _tables(groups: Mapping[str, Sequence[Variable]]) -> Iterator[str]:
    """Yield every group's variables, a line each: name, start, unit, nominal, description; aligned."""
    rows = {
        f"{title} ({len(group)})": [
            (v.name, "" if v.start is None else f"{v.start:g}", v.unit, f"{v.nominal:g}", v.description) for v in group
        ]
        for title, group in groups.items()
    }
    everything = [(title, "start", "unit", "nominal", "") for title in rows]
    everything += [row for group in rows.values() for row in group]
    widths = [max(len(row[i]) for row in everything if i or len(row[0]) <= LONGEST_NAME) for i in range(4)]

    def line(name: str, start: str, unit: str, nominal: str, text: str) -> str:
        left = f"{name:<{widths[0] + 2}}  {start:>{widths[1]}}  {unit:<{widths[2]}}  {nominal:>{widths[3]}}"
        return _cut(f"{left}  {text}")

    for title, group in rows.items():
        yield ""
        yield line(title, "start", "unit", "nominal", "") if group else title
        for name, *rest in group:
            if len(name) > LONGEST_NAME:
                yield f"  {name}"
            yield line("" if len(name) > LONGEST_NAME else f"  {name}", *rest)


def _wrapped(start: str, text: str) -> Iterator[str]:
    """Yield `start` and the text, broken at commas; the lines after the first are indented like it."""
    line = start
    for number, part in enumerate(text.split(", ")):
        piece = part if number == 0 else f", {part}"
        if len(line) + len(piece) + 1 > WIDTH and line.strip():
            yield f"{line},"
            line = " " * len(start) + part
        else:
            line += piece
    yield line


def _cut(text: str) -> str:
    line = " ".join(text.splitlines())
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 3]}..."
