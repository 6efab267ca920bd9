"""Open an FMU's archive safely: entries are judged first, then unpacked into a folder that goes away."""

from __future__ import annotations

import hashlib
import shutil
import stat
import tempfile
import weakref
import zipfile
from pathlib import Path, PurePosixPath

from ctmhe.errors import FmuError


class Unpacked:
    """An FMU unpacked into a private temporary folder.

    The folder lives as long as this object, or until `close`; it is also removed when the interpreter ends.

    Parameters
    ----------
    path : str or Path
        The .fmu file. It is only read.

    Attributes
    ----------
    path, folder : Path
        The file (absolute) and the folder with its contents.
    digest : str
        SHA-256 of the file.

    Raises
    ------
    FmuError
        If the file is missing, no zip archive, damaged, or holds an entry that would leave the folder.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path).expanduser().absolute()
        if not self.path.is_file():
            raise FmuError(f"{self.path}: no such FMU file")
        self.folder = Path(tempfile.mkdtemp(prefix="ctmhe-fmu-")).resolve()
        self._remove = weakref.finalize(self, shutil.rmtree, self.folder, True)
        try:
            self.digest = digest(self.path)
            _extract(self.path, self.folder)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the folder; safe to call twice."""
        self._remove()


def digest(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal text."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _extract(path: Path, folder: Path) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            for entry in entries:
                _check_entry(path, entry)
            for entry in entries:
                archive.extract(entry, folder)
    except (
        zipfile.BadZipFile,
        zipfile.LargeZipFile,
        OSError,
        EOFError,
        RuntimeError,
        NotImplementedError,
    ) as error:
        if isinstance(error, FmuError):
            raise
        raise FmuError(f"{path.name} is not a readable FMU (a zip archive): {error}; export it again") from error
    if not (folder / "modelDescription.xml").is_file():
        raise FmuError(f"{path.name} has no modelDescription.xml at its top level, so it is not an FMU")


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.orig_filename
    mode = entry.external_attr >> 16
    reasons = {
        "it is absolute": name.startswith("/") or ":" in name.split("/")[0],
        "it contains '..'": ".." in PurePosixPath(name).parts,
        "it contains a backslash": "\\" in name,
        "it contains a null character": "\0" in name,
        "it is a link or device": bool(stat.S_IFMT(mode)) and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)),
    }
    for reason, met in reasons.items():
        if met:
            raise FmuError(f"{path.name}: archive entry {name!r} is refused because {reason}; nothing was unpacked")
