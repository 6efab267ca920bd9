"""Variables are chosen by name, pattern and property; units are converted as SI says."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.models.fmu.description import Variable
from ctmhe.models.fmu.selection import select
from ctmhe.models.fmu.units import COMMON, Unit, conversion, instruction


def variable(name: str, causality: str = "local", variability: str = "continuous") -> Variable:
    return Variable(name, 0, causality, variability, None, "", 1.0, None, None, None)


KNOWN = (
    variable("zone2.T", "output"),
    variable("zone1.T", "output"),
    variable("zone10.T"),
    variable("x[1]"),
    variable("x1"),
    variable("zone*.T"),
    variable("der(x[1])"),
    variable("k", "parameter", "tunable"),
    variable("m", "parameter", "fixed"),
    variable("causality:local", "output"),
)


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        (None, [v.name for v in KNOWN]),
        ([], []),
        ("k", ["k"]),
        (["m", "k"], ["m", "k"]),
        ("zone?.T", ["zone2.T", "zone1.T", "zone*.T"]),
        ("zone??.T", ["zone10.T"]),
        ("zone*.T", ["zone*.T"]),
        ("zone**T", ["zone2.T", "zone1.T", "zone10.T", "zone*.T"]),
        ("x[1]", ["x[1]"]),
        ("*[1]*", ["x[1]", "der(x[1])"]),
        (["zone10.T", "zone?.T", "zone1*"], ["zone10.T", "zone2.T", "zone1.T", "zone*.T"]),
        (["zone?.T", "zone1.T"], ["zone2.T", "zone1.T", "zone*.T"]),
        ("causality:output", ["zone2.T", "zone1.T", "causality:local"]),
        ("causality:parameter", ["k", "m"]),
        ("variability:tunable", ["k"]),
        ("causality:local", ["causality:local"]),
    ],
)
def test_what_is_wanted_is_found_once_and_in_order(wanted, expected):
    """The order of the list, within a pattern the FMU's; brackets are literal; a name that exists beats a pattern."""
    assert [v.name for v in select("output", wanted, KNOWN)] == expected


@given(st.lists(st.text(alphabet="ab.[]*?", min_size=1, max_size=4), unique=True, max_size=8), st.data())
def test_a_pattern_finds_what_it_describes(names, data):
    """Replacing a piece of a name by * or a character by ? finds that name, unless the pattern is itself a name."""
    known = [variable(name) for name in names]
    for name in names:
        i = data.draw(st.integers(0, len(name) - 1))
        j = data.draw(st.integers(i, len(name)))
        for pattern in (name[:i] + "*" + name[j:], name[:i] + "?" + name[i + 1 :]):
            found = [v.name for v in select("state", pattern, known)]
            assert found == [pattern] if pattern in names else name in found
            assert found == [each for each in names if each in found]


@pytest.mark.parametrize(
    ("wanted", "told"),
    [
        ("zone1T", "unknown output 'zone1T'; did you mean 'zone1.T'"),
        (["k", "wall*"], "unknown output 'wall*'"),
        ("x[2]", "did you mean 'x\\[1\\]'"),
        ("causality:input", "unknown output 'causality:input'"),
        (["k", "k"], "'k' is named twice"),
        ([3], "expected a name, got 3"),
    ],
)
def test_what_is_not_there_is_told_with_the_nearest(wanted, told):
    """Also a pattern or a property that nothing has."""
    with pytest.raises(InputError, match=told.replace("*", r"\*")):
        select("output", wanted, KNOWN)


def test_a_long_list_of_names_is_not_repeated_in_full():
    """The message stays readable with thousands of variables."""
    with pytest.raises(InputError) as caught:
        select("state", "nothing", [variable(f"v{i}") for i in range(10_000)])
    assert len(str(caught.value)) < 300 and "9988 more" in str(caught.value)


@pytest.mark.parametrize(
    ("given_unit", "wanted", "value", "expected", "told"),
    [
        ("Pa", "bar", 2e5, 2.0, "multiply by 1e-5"),
        ("bar", "Pa", 2.0, 2e5, "multiply by 100000"),
        ("degC", "K", 20.0, 293.15, "add 273.15"),
        ("K", "°C", 293.15, 20.0, "subtract 273.15"),
        ("degF", "degC", 68.0, 20.0, "multiply by 0.555555555556, then subtract 17.7777777778"),
        ("kW", "W", 1.5, 1500.0, "multiply by 1000"),
        ("h", "min", 2.0, 120.0, "multiply by 60"),
        ("%", "1", 50.0, 0.5, "multiply by 0.01"),
        ("furlong", "furlong", 3.0, 3.0, ""),
        ("degC", "°C", 3.0, 3.0, ""),
    ],
)
def test_units_are_converted_as_si_says(given_unit, wanted, value, expected, told):
    """Scale and offset, also between two units with offsets; units of the FMU and common ones mix."""
    own = {"degF": Unit(COMMON["K"].exponents, 5 / 9, 459.67 * 5 / 9)}
    change = conversion(own, given_unit, wanted)
    assert change is not None
    assert math.isclose(change[0] * value + change[1], expected, rel_tol=1e-12)
    assert instruction(*change) == told


@given(st.sampled_from(sorted(COMMON)), st.sampled_from(sorted(COMMON)), st.floats(-1e6, 1e6))
def test_a_conversion_and_its_way_back_change_nothing(one, other, value):
    """To rounding, for every pair that measures the same; no pair converts in one direction only."""
    there, back = conversion({}, one, other), conversion({}, other, one)
    assert (there is None) == (back is None) == (COMMON[one].exponents != COMMON[other].exponents)
    if there and back:
        assert math.isclose(back[0] * (there[0] * value + there[1]) + back[1], value, rel_tol=1e-9, abs_tol=1e-9)


def test_what_cannot_be_converted_is_none_and_the_fmu_has_the_last_word():
    """Different things, unknown units; and a bar that an FMU defines in its own way."""
    assert conversion({}, "bar", "K") is None
    assert conversion({}, "bar", "smoot") is None
    own = {"bar": Unit(COMMON["Pa"].exponents, 2.0)}
    assert conversion(own, "bar", "Pa") == (2.0, 0.0)
