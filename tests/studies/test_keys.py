"""Content keys: the same in every session, another one when anything changes that a run depends on."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from ctmhe import MaxInterval, OdePlant, Periodic, SendOnDelta, trigger
from ctmhe.models.library import batch_reactor
from ctmhe.studies.keys import describe, digest
from fmus.build import build
from tests.conftest import oscillator_mhe

MODULE = '''
from dataclasses import dataclass
import numpy as np
from ctmhe import Trigger, SendOnDelta

GAIN = {gain}
NAMES = {{"b", "a", "c"}}

def helper(x):
    """Two times."""
    return {helper} * x

@dataclass(frozen=True, repr=False)
class Mine(Trigger):
    level: float = 1.0

    def guard(self, ctx):
        return helper(ctx.y[0]) - {inside}

def make(shift):
    def case(*, seed, policy):
        {comment}
        return {{"value": GAIN * shift + len(NAMES), "policy": repr(Mine())}}
    return case

case = make({shift})
'''
DEFAULTS = {"gain": 2.0, "helper": 2, "inside": 1, "comment": "pass", "shift": 3}


def key_of(**changes):
    """The key of `case` in a module of that text."""
    import linecache
    from types import ModuleType

    text = MODULE.format(**DEFAULTS | changes)
    name = "module_of_the_key_test"
    module = ModuleType(name)
    module.__file__ = f"/nowhere/{name}.py"
    linecache.cache[module.__file__] = (len(text), None, text.splitlines(keepends=True), module.__file__)
    sys.modules[name] = module
    try:
        exec(compile(text, module.__file__, "exec"), vars(module))
        return digest(module.case, module.Mine())
    finally:
        del sys.modules[name]


@pytest.mark.parametrize(
    "change", [{"gain": 3.0}, {"helper": 3}, {"inside": 2}, {"shift": 4}, {"comment": "seed += 1"}]
)
def test_whatever_a_case_refers_to_is_part_of_its_key(change):
    """Globals, helpers of helpers, methods of policies, closures, the source itself."""
    assert key_of(**change) != key_of()


def test_comments_are_no_part_of_a_key():
    """A study need not be run again for a remark."""
    assert key_of(comment="pass  # as it was") == key_of()


def test_keys_are_the_same_in_every_session(tmp_path):
    """Neither addresses, nor the order of sets (which changes from session to session), nor the folder matter."""
    (tmp_path / "mine.py").write_text(MODULE.format(**DEFAULTS))
    code = (
        "import mine; from ctmhe.studies.keys import digest; from tests.conftest import oscillator_mhe\n"
        "print(digest(mine.case, mine.Mine(), oscillator_mhe(), lambda x: x + 1))"
    )
    keys = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONHASHSEED": seed, "PYTHONPATH": f"{tmp_path}:.", "CTMHE_COMPILE": "off"},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(keys) == 1


@trigger
def calm(ctx):
    return ctx.elapsed > 0.3


def test_values_that_differ_have_different_keys():
    """Numbers, arrays, policies, estimators, models, FMUs by content."""
    fmu = build("batch_reactor", fmi=2)
    values = [
        *(
            1,
            1.0,
            True,
            "1",
            b"1",
            None,
            [1],
            (1,),
            {1},
            {1: 1},
            np.float64(1),
            np.ones(1),
            np.ones((1, 1)),
            np.array([1]),
        ),
        *(
            Periodic(0.1),
            Periodic(0.2),
            SendOnDelta(0.1),
            SendOnDelta(0.1) | MaxInterval(0.5),
            calm,
            calm | Periodic(0.1),
        ),
        *(oscillator_mhe(), oscillator_mhe(horizon=3.0), batch_reactor(), batch_reactor(noise=False)),
        *(
            partial(describe, 1),
            partial(describe, 2),
            lambda x: x + 1,
            lambda x: x + 2,
            describe,
            np.sin,
            fmu,
            str(fmu),
        ),
        *(
            np.random.default_rng(1),
            np.random.default_rng(2),
            slice(1, 2),
            object(),
            test_values_that_differ_have_different_keys,
        ),
    ]
    described = [describe(value) for value in values]
    same = [i for i, text in enumerate(described) if text in described[:i]]
    assert [values[i] for i in same] == [str(fmu)]  # a file is its content, however it is named


def test_equal_values_have_equal_keys():
    """Whatever order a mapping was filled in, however often a part is shared."""
    array = np.arange(3.0)
    assert describe({"a": 1, "b": 2}) == describe({"b": 2, "a": 1})
    assert describe(array[::2]) == describe(array[::2].copy())
    assert describe(oscillator_mhe()) == describe(oscillator_mhe())
    assert digest([array]) == digest([array.copy()])


def test_a_plant_that_was_used_has_the_key_that_it_had():
    """Where it stands is no part of what it is; its model and tolerances are."""
    plant = OdePlant(batch_reactor())
    before = describe(plant)
    plant.start(0.0, np.array([3.0, 1.0]))
    plant.advance(0.5, np.zeros(0), np.zeros(0), np.zeros(3))
    assert describe(plant) == before
    assert (
        len({before, describe(OdePlant(batch_reactor(), rtol=1e-6)), describe(OdePlant(batch_reactor(noise=False)))})
        == 3
    )


def test_what_refers_to_itself_has_a_key_too():
    """A list inside itself; a function that calls itself."""
    endless: list = [1]
    endless.append(endless)
    assert describe(endless) == describe(endless)

    def down(n):
        return down(n - 1) if n else 0

    assert describe(down) == describe(down)
