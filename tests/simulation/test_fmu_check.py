"""`check_fmu` says what an FMU is good for, for every FMU of the collection and every damaged one."""

import pytest

pytest.importorskip("fmpy")

from typer.testing import CliRunner

from ctmhe.cli import app
from ctmhe.simulation.fmu import check_fmu
from ctmhe.simulation.fmu.check import ESTIMATOR, PARAMETERS, PLANT, UNUSABLE
from fmus.build import build
from fmus.models import MODELS
from tests.models.damaged import damaged

VERDICTS = {
    "bouncing_ball": PLANT,
    "switched_heater": PLANT,
    "fixed_parameters": ESTIMATOR,
    "crashes_at_load": UNUSABLE,
    "no_saving": PLANT,
    "arrays": PLANT,
    "structural": PLANT,
}
WARNED = {"wrong_dependencies", "no_dependencies", "wrong_derivatives"}


@pytest.mark.parametrize("name", MODELS)
def test_each_fmu_of_the_collection_gets_the_right_verdict(name):
    """None is accepted for more than it can do, in any version; what was worked around is a warning."""
    for fmi in MODELS[name].versions:
        found = check_fmu(build(name, fmi=fmi))
        assert found.verdict == VERDICTS.get(name, PARAMETERS), str(found)
        results = {row.check: row.result for row in found.rows}
        assert ("warning" in results.values()) == (name in WARNED)
        assert ("refused" in results.values()) == (found.verdict in (PLANT, UNUSABLE))
        assert bool(found.parameters) == (found.verdict == PARAMETERS or name in ("bouncing_ball", "switched_heater"))
        assert max(map(len, str(found).splitlines())) <= 100


def test_damaged_fmus_are_unusable_for_the_named_reason(tmp_path):
    """The class of the error is in the table; nothing is raised. An array leaves a plant."""
    for name, (path, expected) in damaged(tmp_path).items():
        found = check_fmu(path)
        assert found.verdict == (PLANT if name == "array" else UNUSABLE), str(found)
        assert type(found.error) is expected, name
        assert expected.__name__ in str(found)


def test_the_command_line_prints_the_table_and_fails_for_an_unusable_fmu(tmp_path):
    """Several files, one after the other; exit code 1 when one of them is of no use."""
    (tmp_path / "none.fmu").write_bytes(b"nothing")
    good = CliRunner().invoke(app, ["fmu", "check", str(build("pendulum", fmi=2))])
    assert good.exit_code == 0
    assert "verdict: estimator with parameters" in good.output
    both = CliRunner().invoke(app, ["fmu", "check", str(build("pendulum", fmi=2)), str(tmp_path / "none.fmu")])
    assert both.exit_code == 1
    assert "FmuArchiveError" in both.output
