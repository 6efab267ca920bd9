"""A folder of FMUs that are damaged or hostile, each in one way, with the error that each deserves."""

from __future__ import annotations

import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

from ctmhe.errors import FmuArchiveError, FmuBinaryError, FmuError, FmuUnsupportedError, FmuVersionError
from fmus.build import build

DESCRIPTION = "modelDescription.xml"
ARRAY = """<Float64 name="field" valueReference="99" causality="input" start="1 2"><Dimension start="2"/></Float64>
  </ModelVariables>"""


def rewritten(
    source: Path,
    target: Path,
    *,
    change: Callable[[str], str] = lambda text: text,
    keep: Callable[[str], bool] = lambda name: True,
    alter: Callable[[str, bytes], bytes] = lambda name, data: data,
    add: tuple[tuple[str | zipfile.ZipInfo, bytes], ...] = (),
) -> Path:
    """Copy an FMU: `change` its description, `keep` some entries only, `alter` contents, `add` entries at the end."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.infolist():
            data = old.read(entry)
            if entry.filename == DESCRIPTION:
                data = change(data.decode()).encode()
            if keep(entry.filename):
                new.writestr(entry.filename, alter(entry.filename, data))
        for entry, data in add:
            new.writestr(entry, data)
    return target


def special(name: str, kind: int) -> zipfile.ZipInfo:
    """Return an entry that claims to be a link, pipe or device."""
    entry = zipfile.ZipInfo(name)
    entry.external_attr = (kind | 0o777) << 16
    return entry


def with_wrong_checksum(source: Path, target: Path) -> Path:
    """Copy an FMU with a stored entry, used by nothing, of which one byte has changed."""
    text = b"nobody reads this"
    rewritten(source, target, add=((zipfile.ZipInfo("resources/unused.txt"), text),))
    data = bytearray(target.read_bytes())
    data[data.index(text)] ^= 1
    target.write_bytes(data)
    return target


def with_central_field(source: Path, target: Path, name: str, offset: int, value: int) -> Path:
    """Copy an archive with a 16-bit field of an entry's central directory header replaced."""
    data = bytearray(source.read_bytes())
    at = data.index(b"PK\x01\x02")
    while data[at + 46 : at + 46 + len(name)] != name.encode():
        at = data.index(b"PK\x01\x02", at + 4)
    data[at + offset : at + offset + 2] = struct.pack("<H", value)
    target.write_bytes(data)
    return target


def damaged(folder: Path) -> dict[str, tuple[Path, type[FmuError]]]:
    """Write damaged FMUs into `folder`; return by name the file and the class of the error that opening it gives.

    `truncated binary`, `no binary`, `wrong guid` (`FmuBinaryError`) and `array` (`FmuUnsupportedError`) open without
    an error: they fail when a model is made of them.
    """
    fmi2, fmi3 = build("van_der_pol", fmi=2), build("van_der_pol", fmi=3)
    whole = fmi2.read_bytes()

    def write(name: str, data: bytes) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    def added(name: str, *entries: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
        return rewritten(fmi2, folder / f"{name}.fmu", add=entries)

    def changed(name: str, old: str, new: str, source: Path = fmi2) -> Path:
        return rewritten(source, folder / f"{name}.fmu", change=lambda text: text.replace(old, new))

    archives = {
        "traversal": added("traversal", ("../../evil.txt", b"evil")),
        "absolute": added("absolute", ("/tmp/evil.txt", b"evil")),
        "drive": added("drive", ("C:/evil.txt", b"evil")),
        "backslash": added("backslash", ("..\\evil.txt", b"evil")),
        "control character": added("control", ("resources/a\x1bb.txt", b"evil")),
        "symlink": added("symlink", (special("resources/link", stat.S_IFLNK), b"/etc/passwd")),
        "device": added("device", (special("resources/device", stat.S_IFCHR), b"")),
        "case": added("case", ("MODELDESCRIPTION.xml", b"<evil/>")),
        "file and folder": added("file and folder", ("resources/a", b""), ("resources/a/b", b"")),
        "bomb": added("bomb", ("resources/zeros.bin", bytes(64 << 20))),
        "checksum": with_wrong_checksum(fmi2, folder / "checksum.fmu"),
        "encrypted": with_central_field(fmi2, folder / "encrypted.fmu", "sources/core.c", 8, 1),
        "compression": with_central_field(fmi2, folder / "compression.fmu", "sources/core.c", 10, 99),
        "truncated zip": write("truncated.fmu", whole[: len(whole) // 2]),
        "garbage": write("garbage.fmu", b"this is no archive " * 100),
        "empty": write("empty.fmu", b""),
        "no description": rewritten(fmi2, folder / "no description.fmu", keep=lambda name: name != DESCRIPTION),
        "broken xml": rewritten(fmi2, folder / "broken.fmu", change=lambda text: text[: len(text) // 2]),
        "entities": changed("entities", "<fmiModel", '<!DOCTYPE a [<!ENTITY b "c">]>\n<fmiModel'),
        "bad number": changed("bad number", 'start="2.0"', 'start="two"'),
        "no such state": changed("no such state", 'derivative="2"', 'derivative="1000"'),
    }
    half = rewritten(
        fmi2,
        folder / "truncated binary.fmu",
        alter=lambda name, data: data[: len(data) // 2] if name.startswith("binaries/") else data,
    )
    none = rewritten(fmi2, folder / "no binary.fmu", keep=lambda name: not name.startswith("binaries/"))
    versions = {
        "version 1": changed("version 1", 'fmiVersion="2.0"', 'fmiVersion="1.0"'),
        "version 4": changed("version 4", 'fmiVersion="3.0"', 'fmiVersion="4.0"', fmi3),
    }
    return (
        {name: (path, FmuArchiveError) for name, path in archives.items()}
        | {name: (path, FmuVersionError) for name, path in versions.items()}
        | {
            "truncated binary": (half, FmuBinaryError),
            "no binary": (none, FmuBinaryError),
            "wrong guid": (changed("wrong guid", 'guid="{', 'guid="{0'), FmuBinaryError),
            "array": (changed("array", "</ModelVariables>", ARRAY, fmi3), FmuUnsupportedError),
        }
    )


OPENS = {"truncated binary", "no binary", "wrong guid", "array"}
"""Those of `damaged` whose error comes after opening."""
