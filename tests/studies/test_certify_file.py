"""`ctmhe certify`: a file becomes a report; what is wrong in it is named."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from ctmhe.cli import app
from ctmhe.errors import InputError
from ctmhe.studies.certify_file import certify_file, report

CASE = """
[model]
model = "batch_reactor"
[domain]
x = { pA = [0.1, 5.0] }
[certificate]
eta = 0.4
Q = [1e3, 1e3, 1e2]
R = 1e2
objective = "P"
horizon = 2.0
wait = 0.19
"""


@pytest.fixture
def case(tmp_path):
    def write(text):
        path = tmp_path / "case.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_the_report_says_what_where_how_rigorous_and_how_long(case, tmp_path):
    """Rate, horizon and wait of thesis 3.4.1, the domain by names, the proof by its method; JSON on demand."""
    result = CliRunner().invoke(app, ["certify", str(case(CASE)), "--json", str(tmp_path / "out.json")])
    assert result.exit_code == 0, result.output
    for part in ("eta = 0.4 per second", "yes; domain covered by: vertices", "1.7029 s", "rho = 0.86038", "pB any"):
        assert part in result.output
    assert json.loads((tmp_path / "out.json").read_text())["rigorous"] is True


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("eta = 0.4", "etta = 0.4", "unknown key 'etta'; did you mean 'eta'"),
        ('model = "batch_reactor"', "", r"needs model \(of the library\) or fmu"),
        ("batch_reactor", "reactor", "expected one of batch_reactor"),
        ("pA = ", "pC = ", "pC"),
        ("[domain]", "[domane]", "unknown key 'domane'"),
        ("x = { pA = [0.1, 5.0] }", "x = 5.0", r"a box is a pair \[lower, upper\]"),
        ("eta = 0.4", 'eta = "0.4"', r"eta must lie in \(0, 1\)"),
        ("R = 1e2", 'R = "much"', "R: expected numbers"),
        ("eta = 0.4", "eta = 0.4\nseed = -1", "seed must be a whole number"),
        ("wait = 0.19", "wait = -1", r"\[certificate\] wait must be a number >= 0"),
    ],
)
def test_mistakes_in_a_file_are_named(case, old, new, match):
    """File, table and key, with the nearest known one."""
    with pytest.raises(InputError, match=match):
        certify_file(case(CASE.replace(old, new)))


def test_a_horizon_that_is_too_short_guarantees_nothing(case):
    """The report says so instead of a rate."""
    assert "no guarantee" in report(certify_file(case(CASE.replace("horizon = 2.0", "horizon = 1.0"))))
