"""C compilers on this machine, and a cache of what they built, keyed by all that went into it."""

from __future__ import annotations

import atexit
import json
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path

from ctmhe.errors import SolverError

logger = logging.getLogger(__name__)

FORMAT = 1  # of the cache
TIMEOUT = 300.0  # seconds for one run of a compiler
WINDOWS, MACOS = sys.platform == "win32", sys.platform == "darwin"
SUFFIX = ".dll" if WINDOWS else ".so"

# Results must not depend on the processor or on how the compiler contracts a*b + c.
FLAGS = ("-std=c99", "-O3", "-fno-math-errno", "-ffp-contract=off")
SHARED = () if WINDOWS else ("-fPIC", "-fno-semantic-interposition")
# for what stays on this machine: wider vectors, with the same results as long as nothing is contracted
NATIVE = ("-march=native", "-mtune=generic") if platform.machine().lower() in ("x86_64", "amd64") else ()
# each library binds its names to itself: many of them live in one process
LINK = ("-Wl,--export-all-symbols",) if WINDOWS else ("-lm",) if MACOS else ("-lm", "-ldl", "-Wl,-Bsymbolic")


@dataclass(frozen=True)
class Compiler:
    """A C compiler: how to call it, and what tells it from any other (resolved path, arguments, version line)."""

    command: tuple[str, ...]
    identity: str

    @property
    def gnu(self) -> bool:
        """Whether it takes the flags that only GCC knows."""
        return "clang" not in self.identity.lower() and "zig" not in self.identity.lower()


@dataclass(frozen=True)
class Source:
    """A translation unit: file name, C text, and flags for it that follow the common ones."""

    name: str
    text: str
    flags: tuple[str, ...] = ()


# ---- finding a compiler --------------------------------------------------------------------------------------------


def find_compiler() -> Compiler | None:
    """Return the first that works of `$CC` (may have arguments), cc, gcc, clang and the `ziglang` wheel, or None."""
    return _find_compiler(os.environ.get("CC", ""), os.environ.get("PATH", os.defpath))


@lru_cache(maxsize=16)
def _find_compiler(chosen: str, path: str) -> Compiler | None:
    for command in filter(None, (chosen, "cc", "gcc", "clang")):
        program, *arguments = shlex.split(command, posix=not WINDOWS)
        found = shutil.which(program, path=path)
        line = _version_line([found, *arguments]) if found else None
        if found and line:
            return Compiler((found, *arguments), " ".join([str(Path(found).resolve()), *arguments, line]))
        if command is chosen:
            logger.warning("CC=%s is not a C compiler that runs here; looking for another", chosen)
    with suppress(PackageNotFoundError):
        return Compiler((sys.executable, "-m", "ziglang", "cc"), f"ziglang {version('ziglang')}")
    logger.info(
        "no C compiler (tried $CC, cc, gcc, clang, ziglang): models run in CasADi's virtual machine, which is slower; "
        "pip install 'ctmhe[compile]' brings one"
    )
    return None


def _version_line(command: Sequence[str]) -> str | None:
    try:
        answer = subprocess.run(
            [*command, "--version"],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=60,
            check=True,
            env=_environment(),
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return next((line.strip() for line in answer.stdout.splitlines() if line.strip()), None)


def extra_flags() -> tuple[str, ...]:
    """Return the compiler flags in `$CTMHE_CFLAGS`, which follow ours: sanitizers, -march=native."""
    return tuple(shlex.split(os.environ.get("CTMHE_CFLAGS", ""), posix=not WINDOWS))


@cache
def processor() -> str:
    """Return what tells this machine's processor from others whose instructions may differ: folders are shared."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return platform.processor()


def _environment() -> dict[str, str]:
    return {**os.environ, "LC_ALL": "C"}


# ---- the cache -----------------------------------------------------------------------------------------------------


def cache_directory() -> Path | None:
    """Return `$CTMHE_CACHE`, or ctmhe in the user's cache folder; None when there is no such folder."""
    if os.environ.get("CTMHE_CACHE"):
        return Path(os.environ["CTMHE_CACHE"])
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA")[: 2 if WINDOWS else 1]:
        if os.environ.get(name):
            return Path(os.environ[name]) / "ctmhe"
    try:
        return Path.home() / ".cache" / "ctmhe"
    except RuntimeError:
        return None


@cache
def _private_directory() -> Path:
    """Return a folder of this process alone, removed at its end: the cache where there is no other."""
    folder, owner = Path(tempfile.mkdtemp(prefix="ctmhe-cache-")), os.getpid()
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    return folder


_lock = threading.Lock()
_failures: dict[str, str] = {}  # what did not compile in this process, by key: it is not tried again


def build_library(
    name: str,
    sources: Sequence[Source] | Callable[[], Sequence[Source]],
    *,
    identity: str = "",
    flags: Sequence[str] = (),
    defines: Mapping[str, object] | None = None,
    include: Sequence[Path] = (),
    compiler: Compiler | None = None,
) -> Path:
    """Return a shared library built from C sources: from the cache, or compiled now.

    Any number of threads and processes may ask at once; one of them compiles. A cached file that is not what was
    written is built again.

    Parameters
    ----------
    name : str
        What the library's file name begins with.
    sources : sequence of Source, or a function that returns it
        A function is called only when the library is not in the cache; `identity` then says what it will return.
    identity : str
        Determines, with `sources`, what is compiled: included files, whatever the sources are generated from.
    flags, defines, include
        Flags, macros and include folders (no part of the key) for every source. A source's own flags and then
        `$CTMHE_CFLAGS` follow.
    compiler : Compiler, optional
        Default: `find_compiler()`.

    Raises
    ------
    SolverError
        There is no compiler, or it refused; with the end of what it said.
    """
    compiler = compiler or find_compiler()
    if compiler is None:
        raise SolverError("no C compiler found: install one, or pip install 'ctmhe[compile]'")
    macros = tuple(f"-D{key}={value}" for key, value in (defines or {}).items())
    flags = (*FLAGS, *SHARED, *flags, *macros)
    given = "" if callable(sources) else [(source.name, source.text, source.flags) for source in sources]
    content = json.dumps(
        [FORMAT, sysconfig.get_platform(), processor(), compiler.identity, flags, extra_flags(), LINK, identity, given]
    )
    key = f"{name}-{sha256(content.encode()).hexdigest()[:32]}"
    root = cache_directory()
    found = _cached(root, key)
    if found:
        return found
    with _lock:
        if key in _failures:
            raise SolverError(_failures[key])
        found = _cached(_private_directory(), key) if _private_directory.cache_info().currsize else None
        if found:
            return found
        with _only_process(root, key):
            found = _cached(root, key)
            if found:
                return found
            try:
                library = _compile(compiler, name, sources() if callable(sources) else sources, flags, include)
            except SolverError as error:
                _failures[key] = str(error)
                logger.warning("%s", error)
                raise
            return _publish(root, key, library)


def _cached(root: Path | None, key: str) -> Path | None:
    """Return the library that the cache holds under a key, if it is whole."""
    if root is None:
        return None
    try:
        entry = json.loads((root / f"{key}.json").read_text())
        library = root / entry["library"]
        intact = sha256(library.read_bytes()).hexdigest() == entry["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return library if intact else None


def _publish(root: Path | None, key: str, library: bytes) -> Path:
    """Put a library in the cache: first the file, whose name tells its content, then the entry that points to it."""
    digest = sha256(library).hexdigest()
    file = f"{key}-{digest[:8]}{SUFFIX}"
    entry = json.dumps({"library": file, "sha256": digest}).encode()
    try:
        if root is None:
            raise FileNotFoundError("there is no cache folder")
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        _write(root / file, library)
        _write(root / f"{key}.json", entry)
    except OSError as error:
        try:
            root = _private_directory()
            _write(root / file, library)
            _write(root / f"{key}.json", entry)
        except OSError as second:
            raise SolverError(f"the compiled library cannot be kept: {error}; {second}") from second
        logger.info("compiled code is kept in %s until this process ends: %s", root, error)
    return root / file


def _write(path: Path, content: bytes) -> None:
    """Write a file so that nobody ever sees a part of it."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o700)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


@contextmanager
def _only_process(root: Path | None, key: str) -> Iterator[None]:
    """Hold the other processes that build the same key, where the system can; without it they build it twice."""
    try:
        import fcntl

        if root is None:
            raise FileNotFoundError
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        path = root / f"{key}.lock"
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    except (ImportError, OSError):
        yield
        return
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        path.unlink(missing_ok=True)  # whoever opens it anew finds the entry
        os.close(handle)


# ---- libraries that came with the package -------------------------------------------------------------------------


def sources_digest(folder: Path) -> str:
    """Return what identifies the C sources in a folder: a line `name sha256` each, as the package's build writes it."""
    files = sorted([*folder.glob("*.c"), *folder.glob("*.h")], key=lambda file: file.name)
    return "".join(f"{file.name} {sha256(file.read_bytes()).hexdigest()}\n" for file in files)


def shipped_library(folder: Path, name: str, flags: Sequence[str] = ()) -> Path | None:
    """Return the library `_<name>` of the C sources in one of the package's folders, or None.

    This is the library that the package's build put beside the sources, if it was built from those that are there now
    (an editable install outlives changes to them) and `$CTMHE_CFLAGS` asks for no build of its own; else one that is
    compiled now from `<name>.c` and cached. None, with the reason logged, when nothing can compile it.
    """
    digest = sources_digest(folder)
    if not extra_flags():
        for place in _install_folders(folder):
            library = _built_from(place, name, digest)
            if library is not None:
                return library
    source = folder / f"{name}.c"
    if not source.is_file() or find_compiler() is None:
        return None
    try:
        return build_library(
            name, [Source(source.name, source.read_text(), tuple(flags))], identity=digest, include=[folder]
        )
    except SolverError:
        return None


@cache
def _install_folders(folder: Path) -> tuple[Path, ...]:
    """Return where a folder's library may lie: beside the sources, or where an editable install puts it."""
    folders = [folder]
    with suppress(PackageNotFoundError):  # not installed: running from a source tree
        inside = Path("ctmhe") / folder.relative_to(Path(__file__).parent)
        folders.append(Path(str(distribution("ctmhe").locate_file(inside))))
    return tuple(folders)


def _built_from(folder: Path, name: str, digest: str) -> Path | None:
    """Return the library in a folder if it was built from the sources with this digest."""
    try:
        if (folder / f"_{name}.sources").read_text() != digest:
            return None
    except OSError:
        return None
    candidates = (folder / f"_{name}{suffix}" for suffix in (".so", ".dll", ".dylib"))
    return next((library for library in candidates if library.is_file()), None)


# ---- compiling -----------------------------------------------------------------------------------------------------


def _compile(
    compiler: Compiler, name: str, sources: Sequence[Source], flags: Sequence[str], include: Sequence[Path]
) -> bytes:
    """Return the library's content: all sources compiled at once, then linked."""
    started = time.perf_counter()
    folders = [f"-I{folder}" for folder in include]
    try:
        with tempfile.TemporaryDirectory(prefix="ctmhe-", ignore_cleanup_errors=True) as directory:
            folder = Path(directory)
            commands, objects = [], []
            for source in sources:
                (folder / source.name).write_text(source.text, encoding="utf-8")
                objects.append(f"{source.name}.o")
                commands.append([*flags, *source.flags, *extra_flags(), *folders, "-c", source.name, "-o", objects[-1]])
            _run(compiler, name, commands, folder)
            library = f"{name}{SUFFIX}"
            _run(compiler, name, [[*flags, *extra_flags(), "-shared", *objects, "-o", library, *LINK]], folder)
            content = (folder / library).read_bytes()
    except OSError as error:
        raise SolverError(f"compiling the {name} library failed: {error}") from error
    logger.info("compiled the %s library in %.1f s", name, time.perf_counter() - started)
    return content


def _run(compiler: Compiler, name: str, commands: Sequence[Sequence[str]], folder: Path) -> None:
    """Run the compiler with each command line at the same time; raise with what it said if one fails."""
    running = [
        subprocess.Popen(
            [*compiler.command, *command],
            cwd=folder,
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
        )
        for command in commands
    ]
    deadline = time.monotonic() + TIMEOUT
    try:
        for process, command in zip(running, commands, strict=True):
            try:
                said, _ = process.communicate(timeout=max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                raise SolverError(f"compiling the {name} library took more than {TIMEOUT:.0f} s") from None
            if process.returncode != 0:
                end = "\n".join(said.strip().splitlines()[-12:])
                line = shlex.join([*compiler.command, *command])
                raise SolverError(f"compiling the {name} library failed ({compiler.identity}):\n{end}\nwith: {line}")
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stdout:
                process.stdout.close()
