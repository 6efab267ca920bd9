"""Which C files an FMU says it is compiled from."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from ctmhe.models.fmu.description import Interface, Sources, platform_folder
from ctmhe.models.fmu.markup import Element, Reader, parse

BUILD = "sources/buildDescription.xml"


def read_sources(
    root: Element, folder: Path, major: int, kinds: Mapping[str, Interface]
) -> dict[str, tuple[Sources, ...]]:
    """Return what each kind is compiled from; kinds without sources are left out.

    FMI 2 lists the files in modelDescription.xml, FMI 3 in sources/buildDescription.xml, where of several
    configurations the one for this platform counts, else the first for all.

    Raises
    ------
    FmuArchiveError
        A file, folder or macro is named that none can be, or buildDescription.xml cannot be parsed.
    """
    found = {}
    if major == 2:
        for kind in kinds:
            names = [_inside(Reader(file, kind), "name") for file in root.findall(f"{kind}/SourceFiles/File")]
            found[kind] = (Sources(tuple(names)),) if names else ()
    elif (folder / BUILD).is_file():
        build = parse(folder / BUILD, "fmiBuildDescription")
        for kind, interface in kinds.items():
            found[kind] = _configured(build, interface.identifier)
    return {kind: sets for kind, sets in found.items() if sets}


def _configured(build: Element, identifier: str) -> tuple[Sources, ...]:
    matching = [c for c in build.findall("BuildConfiguration") if c.get("modelIdentifier") == identifier]
    for wanted in (platform_folder(3), None):
        for configuration in matching:
            if configuration.get("platform") == wanted:
                return tuple(_file_set(element, identifier) for element in configuration.findall("SourceFileSet"))
    return ()


def _file_set(element: Element, identifier: str) -> Sources:
    def readers(tag: str) -> list[Reader]:
        return [Reader(child, f"<{tag}> of {identifier}", BUILD) for child in element.findall(tag)]

    required = [macro for macro in readers("PreprocessorDefinition") if not macro.truth("optional")]
    return Sources(
        files=tuple(_inside(reader, "name") for reader in readers("SourceFile")),
        language=element.get("language", ""),
        defines=tuple((_macro(reader), reader.text("value")) for reader in required),
        includes=tuple(_inside(reader, "name") for reader in readers("IncludeDirectory")),
    )


def _inside(reader: Reader, name: str) -> str:
    path = reader.required(name)
    if path.startswith("/") or re.search(r"[\\:\x00-\x1f]", path) or ".." in path.split("/"):
        raise reader.fail(name, "expected a path inside the folder sources")
    return path


def _macro(reader: Reader) -> str:
    name = reader.required("name")
    if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise reader.fail("name", "expected the name of a macro")
    return name
