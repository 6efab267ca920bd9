"""Every FMU of the collection, and every damaged one, is accepted or refused for the right reason."""

import warnings

import pytest

pytest.importorskip("fmpy")

import numpy as np

from ctmhe.errors import (
    FmuBinaryError,
    FmuError,
    FmuEventError,
    FmuKindError,
    FmuParameterError,
    FmuUnsupportedError,
    FmuWarning,
)
from ctmhe.models.fmu import FmuModel
from fmus.build import build
from fmus.models import MODELS
from tests.models.damaged import damaged

REFUSED = {
    "bouncing_ball": (FmuEventError, "1 event indicator"),
    "switched_heater": (FmuEventError, "time event"),
    "crashes_at_load": (FmuBinaryError, "SIGABRT"),
    "no_saving": (FmuKindError, "canGetAndSetFMUstate"),
    "fixed_step": (FmuKindError, "say step=0.05"),
    "arrays": (FmuUnsupportedError, "'motion' is an array"),
    "structural": (FmuUnsupportedError, "'dampers' is a structural parameter"),
}
WARNED = {
    "zero_nominal": "nominal value 0 of 'angle' is of no use, 1 is taken",
    "wrong_dependencies": r"leave out: der\(rate\) on angle",
    "no_dependencies": "lists no `dependencies` of",
    "wrong_derivatives": "d der\\(rate\\) / d angle is 3.5.* and not -3.5",
}
CASES = [(name, fmi) for name, about in MODELS.items() for fmi in about.versions]


def model_of(name, fmi, **arguments):
    """Return the model; FMUs of co-simulation get a step."""
    if "ModelExchange" not in MODELS[name].kinds:
        arguments["step"] = 0.1
    return FmuModel(build(name, fmi=fmi), **arguments)


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_each_fmu_of_the_collection_gets_its_verdict(name, fmi):
    """Plants are accepted; traps are refused by name, or accepted with a warning that names what is wrong."""
    if name in REFUSED:
        kind, message = REFUSED[name]
        with pytest.raises(kind, match=message):
            model_of(name, fmi)
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = model_of(name, fmi)
    said = [str(warning.message) for warning in caught if warning.category is FmuWarning]
    assert len(said) == (name in WARNED)
    if name in WARNED:
        with pytest.warns(FmuWarning, match=WARNED[name]):
            model_of(name, fmi).close()
    assert model.warnings == tuple(said)
    model.close()


@pytest.mark.parametrize("name", ["wrong_dependencies", "no_dependencies", "wrong_derivatives", "no_derivatives"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.filterwarnings("ignore::ctmhe.errors.FmuWarning")
def test_what_is_worked_around_gives_the_derivatives_of_the_fmu_without_the_trap(name, fmi):
    """Jacobians in x, u and p agree with those of the pendulum, to the accuracy of central differences."""
    p = [4.3, 0.3]
    point = (0.2, [0.4, -0.3], [0.1], [0.01, 0.02], p)
    trap, right = (model_of(n, fmi, parameters=["k", "c"]) for n in (name, "pendulum"))
    for function in ("dynamics", "output"):
        mine, theirs = (getattr(m, function) for m in (trap, right))
        for a, b in zip(*(f.jacobian().call([*point, f(*point)]) for f in (mine, theirs)), strict=True):
            np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("fmi", [2, 3])
def test_parameters_that_change_in_event_mode_only_are_changed_there(fmi):
    """Strict FMUs refuse a set in continuous time; fixed parameters are refused by name."""
    strict, free = (model_of(name, fmi, parameters=["k", "c"]) for name in ("strict_parameters", "pendulum"))
    for p in ([4.0, 0.5], [4.4, 0.4], [3.9, 0.2]):
        point = (0.0, [0.4, -0.3], [0.1], [0.0, 0.0], p)
        np.testing.assert_array_equal(np.array(strict.dynamics(*point)), np.array(free.dynamics(*point)))
    with pytest.raises(FmuParameterError, match="'k' is fixed"):
        model_of("fixed_parameters", fmi, parameters=["k"])


def test_frozen_events_are_accepted_on_request():
    """The ball in flight is a falling mass."""
    with model_of("bouncing_ball", 2, allow_frozen_events=True) as ball:
        np.testing.assert_allclose(np.array(ball.dynamics(0, [1.0, 2.0], [], [0, 0], [])).ravel(), [2.0, -9.81])


def test_damaged_fmus_give_the_named_error_and_leave_nothing(tmp_path, monkeypatch):
    """Nothing is written outside the temporary folder, which is gone afterwards."""
    (tmp_path / "fmus").mkdir()
    (tmp_path / "tmp").mkdir()
    (tmp_path / "here").mkdir()
    cases = damaged(tmp_path / "fmus")
    before = {file.name: file.read_bytes() for file in (tmp_path / "fmus").iterdir()}
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.chdir(tmp_path / "here")
    for name, (path, expected) in cases.items():
        with pytest.raises(FmuError) as caught:
            FmuModel(path)
        assert caught.type is expected, name
        assert not list((tmp_path / "tmp").iterdir()), name
    assert not list((tmp_path / "here").iterdir())
    assert {file.name: file.read_bytes() for file in (tmp_path / "fmus").iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fmus", "here", "tmp"]
