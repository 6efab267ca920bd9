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
SANITIZE = "-fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -g"
# solve, covariance, updates assembled in the core; sizes from one variable a slot to 48; what makes a window degenerate
TESTS = (
    ("test_core.py", "random_quadratic or zero_weights or contradictory or fixed or share or not_finite or equal_bits"),
    ("test_covariance.py", ""),
    ("test_updates.py", "core_assembles or long_way"),
    ("test_wide.py", "every_size"),
    ("test_degenerate.py", "(core and not numpy) or any_window"),
)


def runtime() -> str | None:
    """Return the address sanitizer's library, which has to be loaded before Python; None where there is none."""
    if COMPILER is None:
        return None
    name = "libasan.so" if "clang" not in COMPILER else "libclang_rt.asan-x86_64.so"
    said = subprocess.run([COMPILER, f"-print-file-name={name}"], capture_output=True, text=True, check=False)
    path = Path(said.stdout.strip())
    return str(path.resolve()) if path.is_absolute() and path.exists() else None


LIBRARY = runtime()
pytestmark = [pytest.mark.slow, pytest.mark.skipif(LIBRARY is None, reason="no address sanitizer")]


def environment(tmp_path: Path) -> dict[str, str]:
    """What the sanitized library needs: CTMHE_CFLAGS is respected by every build of the core."""
    return os.environ | {
        "LD_PRELOAD": LIBRARY or "",
        "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:exitcode=97",  # Python frees little at its end
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "CTMHE_CFLAGS": SANITIZE,
        "CTMHE_CACHE": str(tmp_path / "cache"),
        "CTMHE_COMPILE": "off",
        "CC": COMPILER or "",
        "OMP_NUM_THREADS": "1",
    }


def run(arguments: list[str], tmp_path: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with the sanitizers loaded."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )


def test_the_sanitizers_are_awake(tmp_path):
    """A library that reads one element too far, or overflows an integer, ends the process with a report."""
    source = tmp_path / "bad.c"
    source.write_text("double far(const double *x, int n) { return x[n]; }\nint more(int n) { return n + 1; }\n")
    library = tmp_path / "bad.so"
    subprocess.run([COMPILER or "", *SANITIZE.split(), "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    head = f"import ctypes; bad = ctypes.CDLL({str(library)!r}); "
    far = run(["-c", head + "x = (ctypes.c_double * 400)(); bad.far(ctypes.byref(x), 400)"], tmp_path)
    more = run(["-c", head + "bad.more(2**31 - 1)"], tmp_path)
    assert "heap-buffer-overflow" in far.stdout, far.stdout
    assert "signed integer overflow" in more.stdout, more.stdout
    assert far.returncode and more.returncode


def test_the_core_runs_clean(tmp_path):
    """Solves, updates and covariances of every size of kernel and of degenerate windows, without a report."""
    folder = Path(__file__).parent
    names = [str(folder / name) for name, _ in TESTS]
    wanted = " or ".join(f"({choice})" for _, choice in TESTS if choice)
    options = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not slow", "-k", f"test_covariance or {wanted}"]
    done = run(["-m", "pytest", *options, *names], tmp_path)
    assert done.returncode == 0, done.stdout[-6000:]
    assert "passed" in done.stdout
