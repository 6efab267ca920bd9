"""The core's tests touch no memory that is not theirs and rely on nothing that C leaves undefined."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMPILER = next((p for p in (os.environ.get("CC"), "gcc", "clang", "cc") if p and shutil.which(p)), None)
SANITIZE = "-O0 -g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer"
# ctmhe_solve, ctmhe_update, ctmhe_covariance; sizes from one variable a slot to 48; what makes a window degenerate
TESTS = (
    "test_core.py", "test_covariance.py", "test_updates.py", "test_wide.py", "test_degenerate.py", "test_slots.py",
    "../estimators/test_real_time.py::test_a_prepared_quadrotor_is_the_quadrotor",
    "../models/test_fmu_evaluators.py::test_the_core_integrates_an_fmu_as_casadi_does",
    "../models/test_fmu_evaluators.py::test_an_isolated_fmu_gives_the_same_numbers",
    "../models/test_fmu_evaluators.py::test_co_simulation_is_a_step_map",
)  # fmt: skip
# without the core, or with more builds of it
LEFT_OUT = "numpy or compiled or library_for_one_model or every_size_gives or any_window or CVODES or correlated"

# CasADi opens its plugins (IPOPT) with a flag that the sanitizer refuses
SHIM = """
#define _GNU_SOURCE
#include <dlfcn.h>
void *dlopen(const char *name, int flags) {
  void *(*next)(const char *, int) = (void *(*)(const char *, int))dlsym(RTLD_NEXT, "dlopen");
  return next(name, flags & ~RTLD_DEEPBIND);
}
"""


def runtime() -> str | None:
    """Return the libraries that have to be loaded before Python; None where there is no sanitizer."""
    if COMPILER is None:
        return None
    asan = "libasan.so" if "clang" not in COMPILER else "libclang_rt.asan-x86_64.so"
    found = []
    for name in (asan, "libstdc++.so.6"):  # the sanitizer looks for the C++ exceptions of CasADi when it starts
        said = subprocess.run([COMPILER, f"-print-file-name={name}"], capture_output=True, text=True, check=False)
        path = Path(said.stdout.strip())
        if not (path.is_absolute() and path.exists()):
            return None
        found.append(str(path.resolve()))
    return ":".join(found)


LIBRARIES = runtime()
pytestmark = [pytest.mark.slow, pytest.mark.skipif(LIBRARIES is None, reason="no address sanitizer")]


def environment(tmp_path: Path) -> dict[str, str]:
    """What the sanitized library needs: CTMHE_CFLAGS is respected by every build of the core."""
    source, shim = tmp_path / "shim.c", tmp_path / "shim.so"
    source.write_text(SHIM)
    subprocess.run([COMPILER or "", "-shared", "-fPIC", str(source), "-o", str(shim), "-ldl"], check=True)
    report = f"log_path={tmp_path / 'report'}"  # pytest keeps what is printed
    return os.environ | {
        "LD_PRELOAD": f"{shim}:{LIBRARIES}",
        # Python frees little at its end; the shim comes before the sanitizer
        "ASAN_OPTIONS": f"detect_leaks=0:verify_asan_link_order=0:{report}",
        "UBSAN_OPTIONS": f"print_stacktrace=1:{report}",
        "CTMHE_CFLAGS": SANITIZE,
        "CTMHE_CACHE": str(tmp_path / "cache"),
        "CTMHE_COMPILE": "off",
        "CC": COMPILER or "",
        "OMP_NUM_THREADS": "1",
    }


def run(arguments: list[str], tmp_path: Path) -> tuple[int, str]:
    """Run Python with the sanitizers loaded; return its exit code, and what it and the sanitizers said."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    reports = [path.read_text(errors="replace") for path in tmp_path.glob("report*")]
    return done.returncode, "\n".join([done.stdout, *reports])


def test_the_sanitizers_are_awake(tmp_path):
    """A library that reads one element too far, or overflows an integer, ends the process with a report."""
    source = tmp_path / "bad.c"
    source.write_text("double far(const double *x, int n) { return x[n]; }\nint more(int n) { return n + 1; }\n")
    library = tmp_path / "bad.so"
    subprocess.run([COMPILER or "", *SANITIZE.split(), "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    head = f"import ctypes; bad = ctypes.CDLL({str(library)!r}); "
    for call, report in (
        ("x = (ctypes.c_double * 400)(); bad.far(ctypes.byref(x), 400)", "heap-buffer-overflow"),
        ("bad.more(2**31 - 1)", "signed integer overflow"),
    ):
        code, said = run(["-c", head + call], tmp_path)
        assert code != 0
        assert report in said


def test_the_core_runs_clean(tmp_path):
    """Solves, updates and covariances of every size of kernel and of degenerate windows, without a report."""
    files = [str(Path(__file__).parent / name) for name in TESTS]
    choice = ["-m", "not slow", "-k", f"not ({LEFT_OUT})"]
    code, said = run(["-m", "pytest", "-x", "-p", "no:cacheprovider", "--durations=5", *choice, *files], tmp_path)
    assert code == 0, said[-6000:]
    assert "passed" in said
    assert not list(tmp_path.glob("report*")), said[-6000:]
