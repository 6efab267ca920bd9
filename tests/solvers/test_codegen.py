"""Libraries are compiled once, found again, and never trusted when they are not what was written."""

from __future__ import annotations

import ctypes
import logging
import shutil
import subprocess
import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from ctmhe import compilers
from ctmhe.compilers import Source, build_library, find_compiler
from ctmhe.errors import SolverError
from ctmhe.models import ContinuousModel
from ctmhe.models.library import batch_reactor, van_der_pol
from ctmhe.solvers import codegen
from ctmhe.solvers.codegen import shipped_core, specialised_core
from ctmhe.transcription import CVODES, RK4
from ctmhe.transcription.stage import StageFunction

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler on this machine")
ANSWER = [Source("answer.c", "int answer(void) { return ANSWER; }")]
FORTY_TWO = {"ANSWER": 42}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch) -> Path:
    """An empty cache, and nothing remembered from other tests."""
    monkeypatch.setenv("CTMHE_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CTMHE_CFLAGS", raising=False)
    monkeypatch.setattr(compilers, "_failures", {})
    compilers._find_compiler.cache_clear()
    return tmp_path / "cache"


@pytest.fixture
def runs(monkeypatch) -> list[list[str]]:
    """The command lines given to the compiler."""
    seen, run = [], compilers._run

    def counted(compiler, name, commands, folder):
        seen.extend(commands)
        run(compiler, name, commands, folder)

    monkeypatch.setattr(compilers, "_run", counted)
    return seen


@pytest.fixture(scope="module")
def reactor() -> StageFunction:
    return StageFunction(batch_reactor(), RK4(0.05), signal=False)


def answer(library: Path) -> int:
    return ctypes.CDLL(str(library)).answer()


def evaluate(library: Path, name: str, function: ca.Function, arguments: list[np.ndarray]) -> list[np.ndarray]:
    """Call a compiled function, with work memory as it asks for."""
    compiled = ctypes.CDLL(str(library))
    sizes = [ctypes.c_longlong() for _ in range(4)]
    getattr(compiled, f"{name}_work")(*map(ctypes.byref, sizes))
    n_arg, n_res, n_iw, n_w = (size.value for size in sizes)
    results = [np.empty((function.size2_out(i), function.size1_out(i))) for i in range(function.n_out())]
    arg = (ctypes.c_void_p * n_arg)(*(array.ctypes.data for array in arguments))
    res = (ctypes.c_void_p * n_res)(*(array.ctypes.data for array in results))
    code = getattr(compiled, name)(arg, res, (ctypes.c_longlong * max(1, n_iw))(), (ctypes.c_double * max(1, n_w))(), 0)
    assert code == 0
    return [result.T for result in results]


@needs_compiler
def test_what_is_cached_is_not_compiled_again(runs):
    """The second request for the same content runs no compiler; the first runs one compilation and one link."""
    first = build_library("answer", ANSWER, defines=FORTY_TWO)
    assert answer(first) == 42 and len(runs) == 2
    assert build_library("answer", ANSWER, defines=FORTY_TWO) == first and len(runs) == 2


@needs_compiler
def test_whatever_goes_in_changes_the_key(runs, monkeypatch):
    """Other text, flags of one source, flags, macros, identity, $CTMHE_CFLAGS or compiler: another library."""
    compiler = find_compiler()
    assert compiler is not None
    other = compilers.Compiler(compiler.command, compiler.identity + " of tomorrow")
    again = [Source("answer.c", ANSWER[0].text + "\n")]
    optimised = [Source("answer.c", ANSWER[0].text, ("-O1",))]
    libraries = [
        build_library("answer", ANSWER, defines=FORTY_TWO),
        build_library("answer", again, defines=FORTY_TWO),
        build_library("answer", optimised, defines=FORTY_TWO),
        build_library("answer", ANSWER, defines=FORTY_TWO, flags=["-O0"]),
        build_library("answer", ANSWER, defines={"ANSWER": 43}),
        build_library("answer", ANSWER, defines=FORTY_TWO, identity="a header"),
        build_library("answer", ANSWER, defines=FORTY_TWO, compiler=other),
    ]
    monkeypatch.setenv("CTMHE_CFLAGS", "-g")
    libraries.append(build_library("answer", ANSWER, defines=FORTY_TWO))
    keys = {library.name.rsplit("-", 1)[0] for library in libraries}
    assert len(keys) == len(libraries) and len(runs) == 2 * len(libraries)
    assert answer(libraries[4]) == 43


@needs_compiler
@pytest.mark.parametrize("damage", ["cut", "changed", "removed", "entry cut", "entry is no object"])
def test_a_damaged_cache_is_built_again(damage, own_cache, runs):
    """A library or entry that is not what was written is never returned; the next request mends it."""
    library = build_library("answer", ANSWER, defines=FORTY_TWO)
    (entry,) = own_cache.glob("*.json")
    content = library.read_bytes()
    if damage == "removed":
        library.unlink()
    elif damage == "cut":
        library.write_bytes(content[: len(content) // 2])
    elif damage == "changed":
        library.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    else:
        entry.write_text(entry.read_text()[:20] if damage == "entry cut" else "[1]")
    mended = build_library("answer", ANSWER, defines=FORTY_TWO)
    assert len(runs) == 4 and answer(mended) == 42
    build_library("answer", ANSWER, defines=FORTY_TWO)
    assert len(runs) == 4


@needs_compiler
def test_processes_at_once_build_one_library(own_cache):
    """Processes that ask for the same library at the same time get the same valid file; nothing else is left behind."""
    code = (
        "import sys, time; from ctmhe.compilers import Source, build_library\n"
        f"time.sleep(max(0.0, {time.time() + 1.5} - time.time()))\n"
        f"print(build_library('answer', {ANSWER!r}, defines={FORTY_TWO!r}))"
    )
    processes = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    libraries = {process.communicate(timeout=60)[0].strip() for process in processes}
    assert all(process.returncode == 0 for process in processes) and len(libraries) == 1
    assert answer(Path(libraries.pop())) == 42
    assert sorted(file.suffix for file in own_cache.iterdir()) == [".json", compilers.SUFFIX]


@needs_compiler
def test_what_does_not_compile_says_why_once(runs, caplog):
    """A compiler's complaint is in the error and in one warning; the same content is not tried again."""
    broken = [Source("broken.c", "int broken(void) { return no_such_name; }")]
    for _ in range(2):
        with pytest.raises(SolverError, match=r"(?s)broken.*no_such_name"):
            build_library("broken", broken)
    assert len(runs) == 1
    assert [record.levelno for record in caplog.records if "no_such_name" in record.message] == [logging.WARNING]


def test_a_compiler_that_cannot_be_called_is_an_error():
    """A compiler that vanished after it was found gives a SolverError."""
    with pytest.raises(SolverError, match="answer"):
        build_library("answer", ANSWER, compiler=compilers.Compiler(("/no/such/compiler",), "none"))


@needs_compiler
@pytest.mark.parametrize("variable", ["CTMHE_CACHE", "XDG_CACHE_HOME"])
def test_a_cache_that_cannot_be_written_is_replaced(variable, tmp_path, monkeypatch, runs):
    """Where the cache folder cannot be made, a private folder serves this process, and is used again."""
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.delenv("CTMHE_CACHE")
    monkeypatch.setenv(variable, str(tmp_path / "file" / "cache"))
    defines = {"ANSWER": len(variable)}  # the private folder outlives a test
    library = build_library("answer", ANSWER, defines=defines)
    assert answer(library) == len(variable)
    assert build_library("answer", ANSWER, defines=defines) == library and len(runs) == 2


def test_without_a_compiler_nothing_is_compiled(monkeypatch, caplog, reactor, tmp_path):
    """No compiler anywhere: None, and one log record that names what brings one."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(compilers, "version", _not_installed)
    with caplog.at_level(logging.INFO):
        assert find_compiler() is None and specialised_core(reactor, False) is None
    assert sum("ctmhe[compile]" in record.message for record in caplog.records) == 1
    with pytest.raises(SolverError, match="no C compiler"):
        build_library("answer", ANSWER)


def _not_installed(name):
    raise compilers.PackageNotFoundError(name)


@needs_compiler
def test_cc_names_the_compiler_and_its_arguments(monkeypatch, caplog):
    """$CC comes first, with its arguments, which are part of its identity; a $CC that does not run is passed over."""
    usual = find_compiler()
    assert usual is not None
    monkeypatch.setenv("CC", f"{usual.command[0]} -DANSWER=7")
    chosen = find_compiler()
    assert chosen is not None and chosen.command[1:] == ("-DANSWER=7",) and chosen.identity != usual.identity
    assert answer(build_library("answer", ANSWER)) == 7
    monkeypatch.setenv("CC", "no-such-compiler --fast")
    assert find_compiler() == usual and "no-such-compiler" in caplog.text


@needs_compiler
def test_the_compiled_stage_is_the_stage(reactor, runs, rng):
    """The compiled second derivatives equal CasADi's to rounding; the sizes are those of the stage."""
    library = specialised_core(reactor, False)
    assert library is not None
    for name, function in {"curvature": reactor.mapped[2][1]}.items():
        arguments = [rng.uniform(0.1, 1.0, function.size1_in(i)) for i in range(function.n_in())]
        expected = function.call(arguments)
        for result, value in zip(evaluate(library, f"ctmhe_stage_{name}", function, arguments), expected, strict=True):
            np.testing.assert_allclose(result, np.asarray(value), rtol=1e-13, atol=1e-14)
    sizes = [ctypes.c_int() for _ in range(6)]
    ctypes.CDLL(str(library)).ctmhe_sizes(*map(ctypes.byref, sizes))
    assert [size.value for size in sizes[:5]] == [reactor.nx, reactor.nw, reactor.np, reactor.ny, reactor.q]
    done = len(runs)
    again = StageFunction(batch_reactor(), RK4(0.05), signal=False)
    assert specialised_core(again, False) == library and len(runs) == done


@needs_compiler
def test_another_process_finds_the_compiled_stage_without_generating_code(reactor):
    """The key is the same in every process, so that the second finds the library and neither generates nor compiles."""
    library = specialised_core(reactor, False)
    code = (
        "from ctmhe.models.library import batch_reactor; from ctmhe import compilers\n"
        "from ctmhe.solvers import codegen\n"
        "from ctmhe.transcription import RK4; from ctmhe.transcription.stage import StageFunction\n"
        "codegen._generate = compilers._run = None\n"
        "print(codegen.specialised_core(StageFunction(batch_reactor(), RK4(0.05), signal=False), False))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == str(library)


def test_models_beyond_plain_c_are_left_to_the_virtual_machine(caplog, runs):
    """CVODES and callbacks are not generated: None, with what stands in the way in the log."""

    class Python(ca.Callback):
        def __init__(self):
            ca.Callback.__init__(self)
            self.construct("outside", {"enable_fd": True})

        def get_n_in(self):
            return 1

        def get_n_out(self):
            return 1

        def eval(self, arguments):
            return [-arguments[0]]

    outside = Python()
    black_box = ContinuousModel(
        lambda t, x, u, w, p: outside(x) + w, lambda t, x, u, w, p: x, x=["x"], w=["w"], y=["y"]
    )
    with caplog.at_level(logging.INFO, logger=codegen.__name__):
        assert specialised_core(StageFunction(van_der_pol(), CVODES(), signal=False), False) is None
        assert specialised_core(StageFunction(black_box, RK4(0.1), signal=False), False) is None
    assert "CvodesInterface" in caplog.text and "outside" in caplog.text and not runs


@needs_compiler
def test_the_core_is_compiled_when_none_was_shipped(tmp_path, monkeypatch, runs):
    """A source tree compiles the core once; a library that was built from these very sources is used as it is."""
    folder = tmp_path / "core"
    shutil.copytree(codegen.CORE, folder, ignore=shutil.ignore_patterns("_core*"))
    (folder / "core.c").write_text('#include "core.h"\nint answer(void) { return CTMHE_CORE_VERSION; }\n')
    monkeypatch.setattr(codegen, "CORE", folder)
    monkeypatch.setattr(compilers, "_install_folders", lambda _: (folder,))
    library = shipped_core()
    assert library is not None and len(runs) == 2 and shipped_core() == library and len(runs) == 2
    shipped = folder / "_core.so"
    shutil.copy(library, shipped)
    (folder / "_core.sources").write_text(compilers.sources_digest(codegen.CORE))
    assert shipped_core() == shipped
    (folder / "core.h").write_text((folder / "core.h").read_text() + "\n")
    assert shipped_core() not in (shipped, library, None), "a library of other sources must not be used"


def test_the_ziglang_wheel_is_a_compiler(monkeypatch, tmp_path):
    """Where there is no other compiler, the wheel that `ctmhe[compile]` brings compiles."""
    pytest.importorskip("ziglang")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    assert answer(build_library("answer", ANSWER, defines=FORTY_TWO)) == 42
