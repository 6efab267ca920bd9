"""Build the example FMUs for this machine with the C compiler at hand: `python -m fmus.build [NAME ...]`.

A built FMU lies in a cache under a key made of its sources, its description and the compiler, so a second
call returns the same file without compiling.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from ctmhe.compilers import Compiler, find_compiler
from ctmhe.errors import FmuError, InputError, MissingExtra
from fmus.config import config_header
from fmus.description import build_description, model_description
from fmus.models import MODELS

SOURCES = Path(__file__).parent / "src"
FLAGS = ("-shared", "-fPIC", "-O2", "-std=c99", "-fvisibility=hidden")
_SUFFIX = {"Linux": ".so", "Darwin": ".dylib", "Windows": ".dll"}
_FMI2_SYSTEM = {"Linux": "linux", "Darwin": "darwin", "Windows": "win"}
_FMI3_SYSTEM = {"Linux": "linux", "Darwin": "darwin", "Windows": "windows"}
_ARCHITECTURE = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}


def build(name: str, fmi: int = 2, out: Path | None = None) -> Path:
    """Build the FMU of one example model, or find it built before.

    Parameters
    ----------
    name : str
        A key of `fmus.models.MODELS`; the plants are those whose description has an empty `trap`.
    fmi : int
        2 or 3: the major version of FMI.
    out : Path, optional
        Folder to copy the FMU into; the cache folder when omitted.

    Returns
    -------
    Path
        The file `<name>_fmi<fmi>.fmu`.

    Raises
    ------
    InputError
        The name or the version is unknown, or the model does not exist in this version.
    FmuError
        There is no C compiler, or it fails.
    MissingExtra
        fmpy, which brings the FMI headers, is not installed.
    """
    if name not in MODELS:
        raise InputError(f"there is no example FMU named '{name}': choose one of {', '.join(MODELS)}")
    if fmi not in (2, 3):
        raise InputError(f"FMI version {fmi!r} is not available: choose 2 or 3")
    if fmi not in MODELS[name].versions:
        raise InputError(f"{name} exists in FMI {_versions(name)} only: its point needs what FMI {fmi} does not have")
    compiler = find_compiler()
    if compiler is None:
        raise FmuError(
            "building an FMU needs a C compiler, and none of $CC, cc, gcc, clang, ziglang runs here: install one"
            " (Debian: apt install build-essential; anywhere: pip install 'ctmhe[compile]')"
        )
    files = _files(name, fmi)
    key = _digest(*files, *files.values(), *FLAGS, compiler.identity, _platform_folder(fmi))
    target = _cache() / key[:16] / f"{name}_fmi{fmi}.fmu"
    if not target.is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="building-", dir=target.parent) as folder:
            made = _pack(name, fmi, files, compiler, Path(folder))
            os.replace(made, target)
    return target if out is None else _copy(target, Path(out))


def _versions(name: str) -> str:
    return " and ".join(map(str, MODELS[name].versions))


def _files(name: str, fmi: int) -> dict[str, str]:
    """Texts of the FMU by their path in it; the token is a hash of all the others."""
    model = MODELS[name]
    units = [f"fmi{fmi}.c", "core.c", "step.c", f"{model.source or name}.c"]
    headers = ["core.h", "model.h", *(["fails.h"] if model.defect == "fails" else [])]
    files = {f"sources/{n}": (SOURCES / n).read_text(encoding="utf-8") for n in (*units, *headers)}
    contents = _digest(*files.values(), config_header(model, ""), model_description(model, fmi, "", units))
    token = "{" + str(uuid.uuid5(uuid.NAMESPACE_OID, contents)) + "}"
    files["sources/config.h"] = config_header(model, token)
    files["modelDescription.xml"] = model_description(model, fmi, token, units)
    if fmi == 3:
        files["sources/buildDescription.xml"] = build_description(model, units)
    return files


def _digest(*texts: str) -> str:
    total = hashlib.sha256()
    for text in texts:
        total.update(hashlib.sha256(text.encode()).digest())
    return total.hexdigest()


def _headers() -> Path:
    """Folder of the FMI headers; found without importing fmpy."""
    spec = find_spec("fmpy")
    if spec is None or spec.origin is None:
        raise MissingExtra("fmpy", "fmu", "Building an FMU")
    return Path(spec.origin).parent / "c-code"


def _platform_folder(fmi: int) -> str:
    system = platform.system()
    if system not in _SUFFIX:
        raise FmuError(f"FMUs are built for Linux, macOS and Windows, not for {system}")
    if fmi == 2:
        return _FMI2_SYSTEM[system] + ("64" if sys.maxsize > 2**32 else "32")
    machine = platform.machine().lower()
    return f"{_ARCHITECTURE.get(machine, machine)}-{_FMI3_SYSTEM[system]}"


def _cache() -> Path:
    here = Path(__file__).parent
    if os.access(here, os.W_OK):
        return here / "_build"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ctmhe" / "fmus"


def _pack(name: str, fmi: int, files: dict[str, str], compiler: Compiler, folder: Path) -> Path:
    """Compile the sources in `folder` and zip them with the binary; the archive carries no dates."""
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    library = f"binaries/{_platform_folder(fmi)}/{name}{_SUFFIX[platform.system()]}"
    (folder / library).parent.mkdir(parents=True)
    units = [path for path in files if path.endswith(".c")]
    command = [*compiler.command, *FLAGS, f"-I{_headers()}", "-Isources", *units, "-o", library, "-lm"]
    try:
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    except OSError as error:
        raise FmuError(
            f"the C compiler '{compiler.command[0]}' could not be run: {error}; set CC to another"
        ) from error
    if run.returncode != 0:
        raise FmuError(f"the C compiler failed on {name} (FMI {fmi}); try another through CC. It says:\n{run.stderr}")
    archive = folder / "made.fmu"
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as target:
        for path in ("modelDescription.xml", library, *sorted(set(files) - {"modelDescription.xml"})):
            entry = zipfile.ZipInfo(path)  # dated 1980: the same inputs give the same bytes
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            target.writestr(entry, (folder / path).read_bytes())
    return archive


def _copy(source: Path, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="copying-", dir=folder) as temporary:
        shutil.copyfile(source, Path(temporary) / source.name)
        os.replace(Path(temporary) / source.name, folder / source.name)
    return folder / source.name


def _chosen_versions(name: str, names: Sequence[str], asked: Sequence[int] | None) -> Sequence[int]:
    """Versions to build: of a model that was named those asked for, else those among them that exist."""
    if name not in MODELS or (names and asked):
        return asked or (2,)  # what cannot be built is refused there
    return [fmi for fmi in MODELS[name].versions if fmi in (asked or (2, 3))]


def main(arguments: Sequence[str] | None = None) -> int:
    """Build the FMUs named on the command line, all when none is, and print where they are."""
    parser = argparse.ArgumentParser(prog="python -m fmus.build", description="Build the example FMUs.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(MODELS)}; all when omitted")
    parser.add_argument("--out", type=Path, help="folder to copy the FMUs into")
    parser.add_argument("--fmi", type=int, nargs="+", choices=(2, 3), help="versions of FMI; all that there are")
    chosen = parser.parse_args(arguments)
    try:
        for name in chosen.names or MODELS:
            for fmi in _chosen_versions(name, chosen.names, chosen.fmi):
                print(build(name, fmi, chosen.out))
    except (FmuError, InputError, MissingExtra) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
