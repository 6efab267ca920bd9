"""Open an FMU's archive safely: judge its entries, then unpack them into a private folder that goes away."""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import struct
import tempfile
import unicodedata
import weakref
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from ctmhe.errors import FmuArchiveError

# Caps are far above what FMUs need (a few hundred entries, some 100 MB) and far below what hurts a machine.
MAX_FILE = 2 << 30  # bytes of the .fmu itself, which is copied before it is read
MAX_ENTRIES = 20_000  # unpacked one by one; whole tool installations stay below
MAX_ENTRY = 1 << 30  # bytes of one unpacked file
MAX_TOTAL = 4 << 30  # bytes of all unpacked files
MAX_RATIO = 250  # unpacked over packed: XML reaches 50, sparse tables 150, a bomb the 1030 that deflate can do
FREE_RATIO = 16 << 20  # bytes of a file up to which its ratio does not matter
MAX_NAME = 255  # bytes of a file's or folder's name, as file systems have it
MAX_PATH = 2048  # characters of an entry's name, folders included
CHUNK = 1 << 20

METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}  # the two that the FMI standards allow
ENCRYPTED = 0x1 | 0x40 | 0x2000  # general purpose bits: encrypted, strongly encrypted, encrypted directory
# what zipfile and zlib raise on bytes that are no archive, whatever the bytes
DAMAGE = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
)


class Unpacked:
    """An FMU unpacked into a private temporary folder.

    The folder lives as long as this object, or until `close`; it is also removed when the interpreter ends. The file
    is copied once: hash and contents belong together even when it changes meanwhile.

    Parameters
    ----------
    path : str or Path
        The .fmu file. It is only read.

    Attributes
    ----------
    path, folder : Path
        The file (absolute) and the folder with its contents.
    digest : str
        SHA-256 of what was read.

    Raises
    ------
    FmuArchiveError
        If the file is missing, no zip archive, damaged, or has an entry that would leave the folder, is hidden by
        another, or is larger than `MAX_ENTRY` and its like allow. The message names the entry.
    """

    def __init__(self, path: str | Path):
        self.path = _absolute(path)
        try:
            private = Path(tempfile.mkdtemp(prefix="ctmhe-fmu-")).resolve()  # mode 0700
        except OSError as error:
            raise FmuArchiveError(f"{self.path.name} needs a temporary folder: {error}; set TMPDIR") from error
        self._remove = weakref.finalize(self, _remove, private, os.getpid())
        self.folder = private / "fmu"
        try:
            self.folder.mkdir()
            with (private / "copy.zip").open("x+b") as copy:
                self.digest = _copy(self.path, copy)
                _unpack(self.path.name, copy, self.folder)
            (private / "copy.zip").unlink()
        except OSError as error:  # of the private folder: what the archive causes is caught where it is read
            self.close()
            raise FmuArchiveError(f"{self.path.name} cannot be unpacked into {private}: {error}") from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the folder; safe to call twice."""
        self._remove()


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # a forked child inherits the object, not the folder
        shutil.rmtree(folder, ignore_errors=True)


def _absolute(path: str | Path) -> Path:
    try:
        return Path(path).expanduser().absolute()
    except RuntimeError as error:
        raise FmuArchiveError(f"{path}: {error}; give the whole path of the FMU") from error


def _copy(path: Path, target: BinaryIO) -> str:
    """Copy the file; return the SHA-256 of what was copied."""
    if path.is_dir():
        raise FmuArchiveError(f"{path} is a folder; give the .fmu file (a zip archive), not what was unpacked from it")
    if not path.exists():
        raise FmuArchiveError(f"{path}: no such FMU file")
    if not path.is_file():  # opening a pipe would wait for ever
        raise FmuArchiveError(f"{path} is a pipe or device, not an FMU file")
    try:
        source = path.open("rb")
    except OSError as error:
        raise FmuArchiveError(f"{path} cannot be read: {error.strerror}; check its permissions") from error
    total, size = hashlib.sha256(), 0
    with source:
        while chunk := source.read(CHUNK):
            size += len(chunk)
            if size > MAX_FILE:
                raise FmuArchiveError(f"{path.name} is larger than {_size(MAX_FILE)}, which no FMU should be")
            total.update(chunk)
            target.write(chunk)
    if not size:
        raise FmuArchiveError(f"{path} is empty; export or copy the FMU again")
    return total.hexdigest()


def _unpack(name: str, file: BinaryIO, folder: Path) -> None:
    try:
        archive = zipfile.ZipFile(file)
    except DAMAGE as error:
        raise FmuArchiveError(
            f"{name} is not a readable FMU (a zip archive): {error}; export or copy it again"
        ) from error
    with archive:
        places = _places(name, archive.infolist(), file.seek(0, os.SEEK_END))
        left = MAX_TOTAL
        for entry, place in places.items():
            target = folder / place
            if entry.is_dir():
                target.mkdir(parents=True, exist_ok=True)
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
            left -= _unpack_entry(name, archive, entry, None if entry.is_dir() else target, left)
        if not any(place == "modelDescription.xml" and not entry.is_dir() for entry, place in places.items()):
            raise FmuArchiveError(f"{name} has no modelDescription.xml at its top level, so it is not an FMU")


def _unpack_entry(name: str, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path | None, left: int) -> int:
    """Unpack one entry, counting its real bytes; a folder (no target) must have none."""
    size, packed = 0, entry.compress_size
    limits = {
        f"it is larger than {_size(MAX_ENTRY)}": MAX_ENTRY,
        f"all entries together are larger than {_size(MAX_TOTAL)}": left,
        f"it grows more than {MAX_RATIO}-fold when unpacked": max(FREE_RATIO, MAX_RATIO * packed),
    }
    with open(target or os.devnull, "xb" if target else "wb") as out:
        for chunk in _chunks(name, archive, entry):
            size += len(chunk)
            for reason, limit in limits.items():
                if size > limit:
                    raise _refused(name, entry, reason)
            out.write(chunk)
    if size and target is None:
        raise _refused(name, entry, "it is a folder with contents")
    if size != entry.file_size:
        raise _damaged(name, entry, f"it holds {size} bytes instead of {entry.file_size}")
    return size


def _chunks(name: str, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterable[bytes]:
    """Yield the contents of an entry; the checksum is compared at its end."""
    try:
        with archive.open(entry) as source:
            while chunk := source.read(CHUNK):
                yield chunk
    except DAMAGE as error:
        raise _damaged(name, entry, str(error) or type(error).__name__) from error


def _places(name: str, entries: list[zipfile.ZipInfo], size: int) -> dict[zipfile.ZipInfo, str]:
    """Return where each entry goes, relative to the folder; raise for the first that must not be unpacked."""
    if len(entries) > MAX_ENTRIES:
        raise FmuArchiveError(f"{name} has {len(entries)} entries, more than the {MAX_ENTRIES} allowed")
    if sum(entry.compress_size for entry in entries) > size:
        raise FmuArchiveError(f"{name} claims more packed bytes than it has: entries overlap or it is cut off")
    places: dict[zipfile.ZipInfo, str] = {}
    names: set[str] = set()
    seen: dict[str, tuple[str, bool]] = {}  # how every file and folder is spelled, and whether it is a folder
    for entry in entries:
        if reason := _reason(entry):
            raise _refused(name, entry, reason)
        parts = [part for part in entry.filename.split("/") if part not in ("", ".")]
        if not parts and not entry.is_dir():
            raise _refused(name, entry, "it has no name")
        for depth in range(1, len(parts) + 1):
            spelled, folder = "/".join(parts[:depth]), depth < len(parts) or entry.is_dir()
            other, was_folder = seen.setdefault(_folded(spelled), (spelled, folder))
            if other != spelled:
                raise _refused(name, entry, f"on some systems {spelled!r} and {other!r} are the same file")
            if folder != was_folder:
                raise _refused(name, entry, f"{spelled!r} is a file and a folder")
        places[entry] = "/".join(parts)
        if places[entry] in names:
            raise _refused(name, entry, "it is there twice")
        names.add(places[entry])
    return places


def _reason(entry: zipfile.ZipInfo) -> str | None:
    """Return why an entry is refused whatever else there is, or None."""
    kind = stat.S_IFMT(entry.external_attr >> 16)
    reasons = {
        "it is a link or device": kind not in {0, stat.S_IFREG, stat.S_IFDIR},
        "it is encrypted": bool(entry.flag_bits & ENCRYPTED),
        f"its compression (method {entry.compress_type}) is none that FMI allows": entry.compress_type not in METHODS,
    }
    for name in (entry.orig_filename, entry.filename):  # an extra field may hold a second name, which then counts
        reasons |= {
            "it is absolute": name.startswith("/"),
            "it contains a colon": ":" in name,  # C:/x, and streams of NTFS
            "it contains '..'": ".." in name.split("/"),
            "it contains a backslash": "\\" in name,
            "it contains a null character": "\0" in name,
            "it contains a control character": any(unicodedata.category(c) in {"Cc", "Cs"} for c in name),
            "its name is too long": len(name) > MAX_PATH
            or any(len(part.encode("utf-8", "replace")) > MAX_NAME for part in name.split("/")),
        }
        if any(reasons.values()):
            break
    return next((reason for reason, met in reasons.items() if met), None)


def _folded(path: str) -> str:
    """Return what names have in common that Windows or macOS take for one file."""
    return "/".join(part.rstrip(". ") for part in unicodedata.normalize("NFC", path).casefold().split("/"))


def _refused(name: str, entry: zipfile.ZipInfo, reason: str) -> FmuArchiveError:
    shown = entry.orig_filename if len(entry.orig_filename) <= 200 else entry.orig_filename[:200] + "..."
    return FmuArchiveError(f"{name}: archive entry {shown!r} is refused because {reason}; nothing was kept")


def _damaged(name: str, entry: zipfile.ZipInfo, reason: str) -> FmuArchiveError:
    return FmuArchiveError(
        f"{name} is not a readable FMU (a zip archive): its entry {entry.filename!r} is damaged: {reason}; export or "
        "copy it again"
    )


def _size(count: int) -> str:
    return f"{count >> 30} GiB" if count >= 1 << 30 else f"{count >> 20} MiB"
