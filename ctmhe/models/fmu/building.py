"""Compile the C sources that an FMU carries, for this platform."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from ctmhe.compilers import TIMEOUT, Compiler, find_compiler
from ctmhe.errors import FmuBinaryError, FmuError, InputError
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.description import Description, Sources, library_suffix, platform_folder
from ctmhe.models.fmu.instance import Instance, _fmpy
from ctmhe.models.fmu.reading import read_description

log = logging.getLogger(__name__)

FLAGS = ("-O2", *(() if sys.platform in {"win32", "cygwin"} else ("-fPIC",)))
# A missing function is the linker's error, not the loader's; every library binds its names to itself.
LINK = ("-Wl,-z,defs", "-Wl,-Bsymbolic", "-lm") if sys.platform.startswith("linux") else ("-lm",)
C_LANGUAGE = re.compile(r"C(\d\d)?", re.IGNORECASE)
SAID = 20  # last lines of what the compiler says that an error repeats


def build(path: str | Path, out: str | Path | None = None) -> Path:
    """Compile the sources of an FMU and write a new FMU with this platform's binary added.

    Binaries of other platforms are kept. The new FMU is opened, and an instance of each kind made, before it is put
    in its place.

    Parameters
    ----------
    path : str or Path
        The .fmu file. It is only read, unless `out` names it too.
    out : str or Path, optional
        The file to write; `<name>_<platform>.fmu` beside `path` when left out.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    FmuArchiveError, FmuVersionError
        The FMU cannot be read.
    FmuBinaryError
        It has no C sources, there is no compiler, the compiler refuses (with its words), or the binary does not run.
    InputError
        `out` is a folder, or cannot be written.
    MissingExtra
        fmpy, which brings the FMI headers, is not installed.
    """
    archive = Unpacked(path)
    try:
        about = read_description(archive.folder)
        target = _target(archive.path, out, platform_folder(about.major))
        _compile_all(about, archive.folder)
        return _publish(archive.folder, target)
    finally:
        archive.close()


def _target(path: Path, out: str | Path | None, platform: str) -> Path:
    target = path.with_name(f"{path.stem}_{platform}.fmu") if out is None else Path(out).expanduser().absolute()
    if target.is_dir():
        raise InputError(f"{target} is a folder; give the name of the FMU to write")
    if not target.parent.is_dir():
        raise InputError(f"there is no folder {target.parent} to write {target.name} into; make it first")
    return target


def _compile_all(about: Description, folder: Path) -> None:
    """Put a library of every identifier that has sources into the unpacked FMU."""
    if not about.sources:
        raise FmuBinaryError(
            f"{about.name} carries no C sources that modelDescription.xml or sources/buildDescription.xml lists, so it "
            f"cannot be compiled; export it with sources, or with a binary for {platform_folder(about.major)}"
        )
    compiler = find_compiler()
    if compiler is None:
        raise FmuBinaryError(
            f"{about.name} cannot be compiled without a C compiler: install one (Debian: build-essential), set CC, or "
            "pip install 'ctmhe[compile]'"
        )
    headers = Path(_fmpy().__file__).parent / "c-code"
    binaries = folder / "binaries" / platform_folder(about.major)
    binaries.mkdir(parents=True, exist_ok=True)
    by_identifier: dict[str, dict[Sources, None]] = {}
    for kind, sets in about.sources.items():
        by_identifier.setdefault(about.kinds[kind].identifier, {}).update(dict.fromkeys(sets))
    with tempfile.TemporaryDirectory(prefix="objects-", dir=folder.parent) as objects:
        for identifier, sets in by_identifier.items():
            library = binaries / f"{identifier}{library_suffix()}"
            _compile(about, compiler, sets, folder / "sources", headers, Path(objects), library)


def _compile(
    about: Description,
    compiler: Compiler,
    sets: Iterable[Sources],
    sources: Path,
    headers: Path,
    objects: Path,
    library: Path,
) -> None:
    """Compile file after file, as every set has macros of its own, then link."""
    made: list[str] = []
    for each in sets:
        if each.language and not C_LANGUAGE.fullmatch(each.language):
            raise FmuBinaryError(f"{about.name} has sources in {each.language}; only C is compiled here")
        # a prefix that the sources define is for static linking: headers of FMI 3 drop it for a library when told so
        macros = [f"-DFMI{about.major}_OVERRIDE_FUNCTION_PREFIX"]
        macros += [f"-D{name}={value}" if value else f"-D{name}" for name, value in each.defines]
        # folders of the FMU come before ours: it may bring its own headers
        folders = [f"-I{folder}" for folder in (*(sources / name for name in each.includes), sources, headers)]
        for name in each.files:
            if Path(name).suffix.lower() != ".c":
                log.info("%s: %s is no C file and is not compiled", about.name, name)
                continue
            if not (sources / name).is_file():
                raise FmuBinaryError(f"{about.name} lists the source {name!r}, but has no such file; export it again")
            made.append(str(objects / f"{library.stem}_{len(made)}.o"))
            file = str(sources / name)  # an absolute path: a name that begins with '-' is no option
            _run(about, compiler, [*FLAGS, *macros, *folders, "-c", file, "-o", made[-1]], sources)
    if not made:
        raise FmuBinaryError(f"{about.name} lists no C files among its sources; export it with its sources")
    _run(about, compiler, ["-shared", *made, "-o", str(library), *LINK], sources)


def _run(about: Description, compiler: Compiler, arguments: list[str], folder: Path) -> None:
    command = [*compiler.command, *arguments]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env={**os.environ, "LC_ALL": "C"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise FmuBinaryError(f"compiling {about.name} took more than {TIMEOUT:.0f} s") from None
    except OSError as error:
        raise FmuBinaryError(f"the C compiler {compiler.command[0]} cannot be run: {error}; set CC") from error
    if done.returncode != 0:
        said = "\n".join(done.stdout.replace(f"{folder}{os.sep}", "").strip().splitlines()[-SAID:])
        raise FmuBinaryError(f"{about.name} does not compile; try another compiler through CC. It says:\n{said}")


def _publish(folder: Path, target: Path) -> Path:
    """Zip the folder beside the target, try the result, and move it into place."""
    try:
        handle, name = tempfile.mkstemp(prefix=".building-", suffix=".fmu", dir=target.parent)
        made = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                _pack(folder, file)
            _try(made)
            made.chmod(0o644)
            os.replace(made, target)
        finally:
            made.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{target} cannot be written: {error.strerror}; choose another place with out=") from error
    return target


def _pack(folder: Path, file: BinaryIO) -> None:
    paths = sorted(folder.rglob("*"), key=lambda path: (path.name != "modelDescription.xml", path))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            name = path.relative_to(folder).as_posix()
            entry = zipfile.ZipInfo(f"{name}/" if path.is_dir() else name)  # dated 1980: same contents, same bytes
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            if path.is_dir():
                entry.external_attr = (0o40755 << 16) | 0x10
            archive.writestr(entry, b"" if path.is_dir() else path.read_bytes())


def _try(path: Path) -> None:
    """Open a built FMU as anybody would, and make an instance of each kind that was compiled."""
    archive = Unpacked(path)
    try:
        about = read_description(archive.folder)
        for kind in about.sources:
            Instance(about, archive.folder, kind).close()
    except FmuError as error:
        raise FmuBinaryError(f"the FMU was compiled but cannot be used: {error}") from error
    finally:
        archive.close()
