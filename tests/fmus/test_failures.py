"""The traps that fail: on evaluation, on loading, on a second instance."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.fmus.equations import point

fmpy = pytest.importorskip("fmpy")

from tests.fmus.instances import DISCARD, ERROR, description, fails_with  # noqa: E402

BOTH = pytest.mark.parametrize("fmi", [2, 3])
UNIX = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of processes")
X, U, P = point("pendulum")


@BOTH
def test_failure_0_and_below_the_limit_there_is_none(opened, fmi):
    """Evaluations fail only above the limit, and only when asked for."""
    instance = opened("fails", fmi, start={"limit": 0.6, "failure": 0})
    for failure, angle in ((0, 0.7), (2, 0.6)):
        instance.set("p", [*P, 0.6, failure])
        instance.set_states([angle, 0.0])
        np.testing.assert_allclose(instance.derivatives(), [0.0, -P[0] * np.sin(angle)], rtol=1e-14)


@BOTH
def test_failure_1_discards_and_recovers(opened, fmi):
    """Evaluating is discarded beyond the limit; the next point is as good as ever."""
    instance = opened("fails", fmi, start={"limit": 0.6, "failure": 1})
    instance.set_states([0.7, 0.0])
    for call in (instance.derivatives, lambda: instance.get("y"), lambda: instance.jacobian("x")):
        fails_with(DISCARD, call)
    instance.set_states([0.5, 0.1])
    np.testing.assert_allclose(instance.derivatives()[0], 0.1)


@BOTH
def test_failure_2_is_for_ever(opened, fmi):
    """After an error every call on that instance is one, at good points too; others are well, and a reset heals."""
    instance, other = (opened("fails", fmi, start={"limit": 0.6, "failure": 2}) for _ in range(2))
    saved = instance.fmu.getFMUState()
    instance.set_states([0.7, 0.0])
    calls = [
        instance.derivatives,
        instance.states,
        lambda: instance.set_states([0.5, 0.0]),
        lambda: instance.get("x"),
        lambda: instance.set("u", U),
        lambda: instance.jacobian("x"),
        lambda: instance.fmu.setTime(0.0),
        lambda: instance.fmu.setFMUState(saved),
        instance.fmu.completedIntegratorStep,
        instance.fmu.enterEventMode,
        instance.event,
        instance.fmu.terminate,
    ]
    for call in calls:
        fails_with(ERROR, call)
    other.set_states([0.5, 0.1])
    other.derivatives()
    instance.fmu.freeFMUState(saved)
    instance.fmu.reset()
    np.testing.assert_array_equal(instance.get("x"), [0.5, 0.0])


@BOTH
def test_failure_3_is_not_a_number(opened, fmi):
    """der(rate) is NaN beyond the limit and a number again before it; nothing is reported."""
    instance = opened("fails", fmi, start={"limit": 0.6, "failure": 3})
    instance.set_states([0.7, 0.2])
    np.testing.assert_array_equal(instance.derivatives(), [0.2, np.nan])
    instance.set_states([0.5, 0.2])
    assert np.isfinite(instance.derivatives()).all()


@BOTH
@pytest.mark.parametrize(("failure", "status"), [(1, DISCARD), (2, ERROR), (3, DISCARD)])
def test_a_failure_fails_a_step(opened, fmi, failure, status):
    """A co-simulation step into the region fails in the same way, and but for an error takes nothing along."""
    instance = opened("fails", fmi, "CoSimulation", start={"limit": 0.6, "failure": failure, "rate": 5.0})
    fails_with(status, instance.fmu.doStep, 0.0, 1.0)
    if failure != 2:
        np.testing.assert_array_equal(instance.get("x"), [0.5, 5.0])


CHILD = """
import resource, sys
from tests.fmus.instances import Opened
folder, name, fmi, failure = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
start = {"limit": 0.6, "failure": float(failure)} if name == "fails" else {}
instance = Opened(folder, name, int(fmi), start=start)
print("opened", flush=True)
instance.set_states([0.7, 0.0])
used = resource.getrusage(resource.RUSAGE_SELF)
second = int(used.ru_utime + used.ru_stime) + 2
resource.setrlimit(resource.RLIMIT_CPU, (second, second + 5))
instance.derivatives()
print("evaluated", flush=True)
"""


def child(unzipped, name, fmi, failure):
    """Evaluate beyond the limit in a process with a second or two of processor time: (its return code, its words)."""
    command = [sys.executable, "-c", CHILD, unzipped(name, fmi), name, str(fmi), str(failure)]
    run = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    return run.returncode, run.stdout.split()


@UNIX
@BOTH
def test_failure_4_and_5_end_the_process_or_never_end(unzipped, fmi):
    """The process is aborted; it computes until its processor time is used up; without a failure it ends well."""
    assert child(unzipped, "fails", fmi, 4) == (-signal.SIGABRT, ["opened"])
    assert child(unzipped, "fails", fmi, 5) == (-signal.SIGXCPU, ["opened"])
    assert child(unzipped, "fails", fmi, 0) == (0, ["opened", "evaluated"])


@UNIX
@BOTH
def test_crashes_at_load_ends_the_process(unzipped, fmi):
    """The process is aborted before there is an instance: in FMI 2 it is enough to load the library."""
    assert child(unzipped, "crashes_at_load", fmi, 0) == (-signal.SIGABRT, [])
    libraries = [str(path) for path in Path(unzipped("crashes_at_load", fmi)).glob("binaries/*/*")]
    code = f"import ctypes, resource; resource.setrlimit(resource.RLIMIT_CORE, (0, 0)); ctypes.CDLL({libraries[0]!r})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert run.returncode == (-signal.SIGABRT if fmi == 2 else 0)


@BOTH
def test_single_instance_refuses_a_second(unzipped, opened, fmi):
    """It is declared for all kinds; a second instance fails while there is one, and works once that is freed."""
    root = description(unzipped("single_instance", fmi))
    for kind in ("ModelExchange", "CoSimulation"):
        assert root.find(kind).get("canBeInstantiatedOnlyOncePerProcess") == "true"
    first = opened("single_instance", fmi)
    for kind in ("ModelExchange", "CoSimulation"):
        with pytest.raises(Exception, match=r"[Ii]nstantiate"):
            opened("single_instance", fmi, kind)
    first.set_states(X)  # the first goes on
    first.derivatives()
    first.close()
    opened("single_instance", fmi)
