"""A description comes out as the standard means it, and whatever is wrong in it is an error of the FMU family."""

import random
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctmhe.errors import FmuArchiveError, FmuError, FmuVersionError
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Sources, Variable
from ctmhe.models.fmu.markup import MAX_DEPTH
from ctmhe.models.fmu.reading import read_description
from ctmhe.models.fmu.report import WIDTH, describe
from fmus.build import build
from tests.models.damaged import ARRAY, rewritten

HOSTILE = [
    *("", " ", "0", "-1", "1", "2", "7", "1e999", "-INF", "NaN", "4294967295", "4294967296", "9" * 5000, "1_0", "٣"),
    *("true", "yes", "continuous", "structuralParameter", "../../evil", "/etc/passwd", "a\\b", "%s%n", "x" * 10_000),
    *("1 2 3", "1 2 x", "bar", "x0", "der(x0)", "2.0", "3.0", "\u202e", "\U0001f600", "'\"<>&"),
]

FMI2 = """<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g" numberOfEventIndicators="3">
  <ModelExchange modelIdentifier="m"/>
  <UnitDefinitions><Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit><Unit name="odd"/></UnitDefinitions>
  <TypeDefinitions>
    <SimpleType name="T"><Real unit="degC" nominal="300" min="-INF" max="1e3"/></SimpleType>
    <SimpleType name="N"><Integer/></SimpleType>
  </TypeDefinitions>
  <ModelVariables>
    <ScalarVariable name="t" valueReference="0" causality="independent"><Real/></ScalarVariable>
    <ScalarVariable name="n" valueReference="1"><Integer start="2"/></ScalarVariable>
    <ScalarVariable name="x" valueReference="1" causality="output"><Real declaredType="T" start="20" reinit="true"/>
    </ScalarVariable>
    <ScalarVariable name="alias" valueReference="1"><Real declaredType="T" min="0"/></ScalarVariable>
    <ScalarVariable name="v" valueReference="5"><Real derivative="3"/></ScalarVariable>
    <ScalarVariable name="a" valueReference="6"><Real derivative="5"/></ScalarVariable>
    <ScalarVariable name="u" valueReference="7" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="p" valueReference="8" causality="parameter"><Real start="INF"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="9" causality="output"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="9" dependencies="1 3 7"/><Unknown index="3" dependencies="3"/></Outputs>
    <Derivatives><Unknown index="6"/><Unknown index="5" dependencies=""/></Derivatives>
  </ModelStructure>
</fmiModelDescription>"""

FMI3 = """<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="g">
  <CoSimulation modelIdentifier="m" hasEventMode="true" mightReturnEarlyFromDoStep="1" fixedInternalStepSize="0.01"/>
  <TypeDefinitions><Float64Type name="T" unit="K" nominal="300"/></TypeDefinitions>
  <ModelVariables>
    <Float64 name="t" valueReference="0" causality="independent"/>
    <Float64 name="x" valueReference="1" declaredType="T" start="20" reinit="true" description="temperature">
      <Alias name="room.T" description="the same"/><Alias name="T"/></Float64>
    <Float64 name="v" valueReference="2" derivative="1"/>
    <Float64 name="z" valueReference="3"/>
    <Float64 name="local" valueReference="4" start="1 2 3"><Dimension start="3"/></Float64>
    <Int32 name="n" valueReference="5" causality="parameter" variability="fixed" start="1"/>
    <Float64 name="k" valueReference="6" causality="parameter" start="2"/>
    <String name="s" valueReference="7"><Start value="a"/></String>
    <Float64 name="y" valueReference="8" causality="output"/>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="8"/>
    <ContinuousStateDerivative valueReference="2" dependencies="1 6"/>
    <EventIndicator valueReference="3"/>
  </ModelStructure>
</fmiModelDescription>"""


def read(folder: Path, text: str | bytes):
    """Read a description that lies in a folder alone."""
    content = text if isinstance(text, bytes) else text.encode()
    (folder / "modelDescription.xml").write_bytes(content)
    return read_description(folder)


def names(variables) -> tuple[str, ...]:
    return tuple(variable.name for variable in variables)


def test_fmi2_comes_out_as_the_standard_means_it(tmp_path):
    """Indices count from 1, aliases share a reference of their type, states may be outputs, types lend attributes."""
    about = read(tmp_path, FMI2)
    assert (names(about.states), names(about.derivatives)) == (("v", "x"), ("a", "v"))
    assert names(about.inputs) == ("u",) and names(about.outputs) == ("x", "y") and names(about.parameters) == ("p",)
    assert set(about.variables) == {"t", "x", "alias", "v", "a", "u", "p", "y"}
    assert about.event_indicators == 3 and about.unsupported == {}
    assert about.dependencies == {"a": None, "v": (), "y": ("t", "x", "u"), "x": ("x",)}
    x, alias = about.variables["x"], about.variables["alias"]
    assert (x.unit, x.nominal, x.minimum, x.maximum, x.start) == ("degC", 300.0, -float("inf"), 1e3, 20.0)
    assert (alias.reference, alias.minimum, alias.maximum) == (x.reference, 0.0, 1e3)
    assert about.units == {"degC": ((0, 0, 0, 0, 1, 0, 0, 0), 1.0, 273.15)}
    initial = {name: variable.initial for name, variable in about.variables.items()}
    assert initial == {"t": None, "u": None, "p": "exact"} | dict.fromkeys(("x", "alias", "v", "a", "y"), "calculated")
    assert not about.variables["t"].settable and about.variables["u"].settable
    assert about.kinds[MODEL_EXCHANGE].completed_step and not about.kinds[MODEL_EXCHANGE].directional_derivatives


def test_fmi3_comes_out_as_the_standard_means_it(tmp_path):
    """References instead of indices, alias names, indicators counted, local arrays and other types left alone."""
    about = read(tmp_path, FMI3)
    assert (names(about.states), names(about.derivatives)) == (("x",), ("v",))
    assert about.event_indicators == 1 and about.unsupported == {}
    assert names(about.parameters) == ("k",) and names(about.outputs) == ("y",)
    assert about.dependencies == {"v": ("x", "k"), "y": None}
    alias = about.variables["room.T"]
    assert (alias.reference, alias.unit, alias.nominal, alias.description) == (1, "K", 300.0, "the same")
    assert about.variables["T"].description == "temperature"
    assert "local" not in about.variables
    kind = about.kinds[CO_SIMULATION]
    assert (kind.event_mode, kind.early_return, kind.fixed_step, kind.variable_step) == (True, True, 0.01, False)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_bundled_fmus_are_described_completely(fmi):
    """Units, dependencies, texts, experiment, platforms and sources of the reactor."""
    archive = Unpacked(build("batch_reactor", fmi=fmi))
    about = read_description(archive.folder)
    archive.close()
    assert about.units["bar"] == ((1, -1, -2, 0, 0, 0, 0, 0), 1e5, 0.0)
    parameters = ("k1", "k2") if fmi == 3 else ()  # FMI 2 does not list them
    assert about.dependencies["der(pA)"] == ("pA", "pB", "d_pA", *parameters)
    assert about.dependencies["pressure"] == ("pA", "pB")
    assert about.variables["pressure"].description == "total pressure pA + pB"
    assert (about.start_time, about.stop_time, about.step) == (0.0, 10.0, 0.1)
    assert len(about.platforms) == 1
    files = (f"fmi{fmi}.c", "core.c", "step.c", "batch_reactor.c")
    expected = (Sources(files, "C99" if fmi == 3 else ""),)
    assert about.sources == {MODEL_EXCHANGE: expected, CO_SIMULATION: expected}


@pytest.mark.parametrize("role", ["input", "output", "parameter", "state", "indicator", "structural"])
def test_arrays_that_matter_are_listed_as_unsupported(tmp_path, role):
    """Those that an estimator or a plant would meet; and structural parameters, arrays or not."""
    array = '<Float64 name="field" valueReference="99"{}><Dimension start="2"/></Float64>'
    text = FMI3
    if role in {"input", "output", "parameter"}:
        extra = array.format(f' causality="{role}"')
    elif role == "structural":
        extra = '<UInt64 name="field" valueReference="99" causality="structuralParameter" start="2"/>'
    else:
        extra = array.format(' derivative="98"' if role == "state" else "")
        extra += array.replace("field", "base").replace("99", "98").format("") if role == "state" else ""
        tag = "ContinuousStateDerivative" if role == "state" else "EventIndicator"
        text = text.replace("</ModelStructure>", f'<{tag} valueReference="99"/></ModelStructure>')
    about = read(tmp_path, text.replace("</ModelVariables>", f"{extra}</ModelVariables>"))
    expected = {"field": "a structural parameter" if role == "structural" else "an array"}
    assert about.unsupported == expected | ({"base": "an array"} if role == "state" else {})
    assert names(about.states) == ("x",)


@pytest.mark.parametrize(
    ("text", "old", "new", "told"),
    [
        (FMI2, 'start="20"', 'start="warm"', "'x'.*'start' is 'warm'"),
        (FMI2, 'start="20"', 'start="nan"', "'x'.*'start'"),
        (FMI2, 'start="20"', 'start="1_0"', "'x'.*'start'"),
        (FMI2, 'min="0"', 'min="2000"', "'alias'.*'min'.*above"),
        (FMI2, 'valueReference="9"', "", "'y'.*'valueReference' is missing"),
        (FMI2, 'valueReference="9"', 'valueReference="-9"', "'y'.*'valueReference' is '-9'"),
        (FMI2, 'valueReference="9"', 'valueReference="4294967296"', "'y'.*'valueReference'"),
        (FMI2, 'valueReference="7"', 'valueReference="5"', "'u'.*'valueReference'.*'v'"),
        (FMI2, 'name="y"', 'name="u"', "'u'"),
        (FMI2, 'name="y"', "", "'name' is missing"),
        (FMI2, 'derivative="3"', "", "'v'.*'derivative' is missing"),
        (FMI2, 'derivative="3"', 'derivative="99"', "'v'.*'derivative' is '99'.*no state"),
        (FMI2, 'derivative="3"', 'derivative="5"', "'v'.*'derivative'.*no state"),
        (FMI2, 'derivative="3"', 'derivative="8"', "'v'.*'derivative'.*'p' is fixed"),
        (FMI2, 'derivative="5"', 'derivative="3"', "'v'.*'derivative'.*'a'"),
        (FMI2, 'index="9"', 'index="99"', "Outputs.*'index' is '99'"),
        (FMI2, 'index="9"', 'index="3"', "Outputs.*'index'.*'x' twice"),
        (FMI2, 'dependencies="1 3 7"', 'dependencies="1 33"', "'y'.*'dependencies'.*33"),
        (FMI2, 'dependencies="1 3 7"', 'dependencies="1 x"', "'y'.*'dependencies'"),
        (FMI2, 'declaredType="T"', 'declaredType="S"', "'x'.*'declaredType' is 'S'"),
        (FMI2, 'declaredType="T"', 'declaredType="N"', "'x'.*'declaredType' is 'N'"),
        (FMI2, 'causality="input"', 'causality="in"', "'u'.*'causality' is 'in'"),
        (
            FMI2,
            'causality="parameter"',
            'causality="parameter" variability="discrete"',
            "'p'.*'variability' is 'discrete'",
        ),
        (FMI2, 'causality="output"><Real/>', 'causality="output" initial="no"><Real/>', "'y'.*'initial' is 'no'"),
        (FMI2, 'reinit="true"', 'reinit="maybe"', "'x'.*'reinit'"),
        (FMI2, 'causality="input"', 'causality="independent"', "'t' and 'u'"),
        (FMI2, 'numberOfEventIndicators="3"', 'numberOfEventIndicators="99999999"', "'numberOfEventIndicators'"),
        (FMI2, 'modelIdentifier="m"', 'modelIdentifier="../m"', "'modelIdentifier'"),
        (FMI2, 'guid="g"', "", "'guid' is missing"),
        (FMI2, 'K="1"', 'K="1.5"', "'degC'.*'K'"),
        (FMI2, '<Integer start="2"/>', "", "'n' has no type"),
        (FMI2, "ModelStructure>", "Structure>", "no element <ModelStructure>"),
        (FMI3, 'valueReference="8"', 'valueReference="6"', "'y'.*'valueReference' is '6'.*'k'"),
        (FMI3, 'Alias name="T"', 'Alias name="k"', "'k'"),
        (FMI3, '<EventIndicator valueReference="3"', '<EventIndicator valueReference="33"', "EventIndicator.*'33'"),
        (FMI3, 'fixedInternalStepSize="0.01"', 'fixedInternalStepSize="0"', "'fixedInternalStepSize'"),
        (
            FMI3.replace("CoSimulation", "ModelExchange"),
            '"1" declaredType="T"',
            '"1" declaredType="T" variability="discrete"',
            "'v'.*'x' is discrete",
        ),
    ],
)
def test_what_is_inconsistent_is_named(tmp_path, text, old, new, told):
    """The variable (or element), the attribute and what it is."""
    assert old in text
    with pytest.raises(FmuArchiveError, match=told):
        read(tmp_path, text.replace(old, new))


def test_a_co_simulation_does_without_derivatives_that_are_wrong(tmp_path):
    """They matter to model exchange only; PythonFMU lists derivatives of inputs."""
    text = FMI3.replace('"1" declaredType="T"', '"1" declaredType="T" causality="input"')
    about = read(tmp_path, text)
    assert about.states == about.derivatives == ()
    assert names(about.inputs) == ("x",)
    assert any("'v'" in remark and "no states" in remark for remark in about.remarks)


def test_a_unit_without_a_name_is_left_out(tmp_path):
    """PythonFMU defines one for variables that have no unit."""
    units = '<Unit name=""><BaseUnit/></Unit><Unit name="degC">'
    assert set(read(tmp_path, FMI2.replace('<Unit name="degC">', units)).units) == {"degC"}


@pytest.mark.parametrize("version", ["1.0", "2.1", "2.0.1", "3", "3.0-beta.1", "4.0", "", "3.0.0.0", "3.٣"])
def test_other_versions_are_refused_by_name(tmp_path, version):
    """FMI 1 and what is not there yet; the message repeats the version."""
    with pytest.raises(FmuVersionError, match=repr(version) if version else "unknown"):
        read(tmp_path, FMI2.replace('fmiVersion="2.0"', f'fmiVersion="{version}"'))


@pytest.mark.parametrize("version", ["3.0", "3.0.2", "3.1"])
def test_minor_versions_of_fmi3_are_read(tmp_path, version):
    """They only add to 3.0."""
    assert read(tmp_path, FMI3.replace('"3.0"', f'"{version}"')).major == 3


def test_xml_that_attacks_is_refused(tmp_path, monkeypatch):
    """Entities, external or nested, depth, size, and encodings that nobody knows."""
    for doctype in (
        '<!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>',
        '<!DOCTYPE a SYSTEM "file:///etc/passwd">',
        "<!DOCTYPE fmiModelDescription>",
    ):
        with pytest.raises(FmuArchiveError, match="DOCTYPE"):
            read(tmp_path, doctype + FMI2)
    deep = "<a>" * MAX_DEPTH + "</a>" * MAX_DEPTH
    with pytest.raises(FmuArchiveError, match="deeper"):
        read(tmp_path, FMI2.replace("<ModelVariables>", f"{deep}<ModelVariables>"))
    for encoding in ("nonsense", "utf-7", "idna", "hex", "utf-16"):
        with pytest.raises(FmuArchiveError, match="cannot be parsed"):
            read(tmp_path, f'<?xml version="1.0" encoding="{encoding}"?>' + FMI2)
    with pytest.raises(FmuArchiveError, match="<html>"):
        read(tmp_path, "<html/>")
    monkeypatch.setattr("ctmhe.models.fmu.markup.MAX_BYTES", 100)
    with pytest.raises(FmuArchiveError, match="MiB"):
        read(tmp_path, FMI2)


def test_other_encodings_are_read(tmp_path):
    """Latin-1 and UTF-16 are as good as UTF-8."""
    text = FMI2.replace('modelName="m"', 'modelName="Gerät"')
    for encoding in ("latin-1", "utf-16"):
        header = f'<?xml version="1.0" encoding="{encoding}"?>'
        assert read(tmp_path, (header + text).encode(encoding)).name == "Gerät"


@pytest.mark.parametrize("nominal", ["0", "-0.0", "-3", "INF", "NaN", "1e-320"])
def test_a_nominal_that_is_no_size_is_one_with_a_warning(tmp_path, nominal):
    """It would divide by zero; the warning names the variable."""
    about = read(tmp_path, FMI2.replace('start="0"', f'nominal="{nominal}"'))
    assert about.variables["u"].nominal == 1.0
    assert len(about.remarks) == 1
    assert "of 'u' is of no use, 1 is taken" in about.remarks[0]


@pytest.mark.parametrize(
    ("element", "name"),
    [("SourceFile", "../x.c"), ("SourceFile", "/x.c"), ("SourceFile", "C:x.c"), ("IncludeDirectory", "a/../../b")],
)
def test_sources_outside_their_folder_are_refused(tmp_path, element, name):
    """A build description cannot reach other files."""
    (tmp_path / "sources").mkdir()
    (tmp_path / "sources/buildDescription.xml").write_text(
        '<fmiBuildDescription fmiVersion="3.0"><BuildConfiguration modelIdentifier="m"><SourceFileSet>'
        f'<{element} name="{name}"/></SourceFileSet></BuildConfiguration></fmiBuildDescription>'
    )
    with pytest.raises(FmuArchiveError, match=r"buildDescription\.xml.*'name'"):
        read(tmp_path, FMI3)


# ---- fuzzing -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def descriptions() -> list[str]:
    texts = [FMI2, FMI3, FMI3.replace("</ModelVariables>", ARRAY)]
    for fmi in (2, 3):
        archive = Unpacked(build("batch_reactor", fmi=fmi))
        texts.append((archive.folder / "modelDescription.xml").read_text())
        archive.close()
    return texts


def mutated(text: str, chance: random.Random) -> str:
    """Return the description with a few attributes or elements dropped, replaced, doubled or swapped."""
    root = ElementTree.fromstring(text)
    for _ in range(chance.randint(1, 4)):
        parents = {child: parent for parent in root.iter() for child in parent}
        element = chance.choice([root, *parents])
        action = chance.choice(["drop attribute", "replace", "replace", "replace", "drop", "double", "swap", "rename"])
        keys = list(element.attrib)
        if action == "drop attribute" and keys:
            del element.attrib[chance.choice(keys)]
        elif action == "replace" and keys:
            element.set(chance.choice(keys), chance.choice(HOSTILE))
        elif action == "rename":
            element.tag = chance.choice([each.tag for each in root.iter()])
        elif element is not root:
            siblings = parents[element]
            if action == "drop":
                siblings.remove(element)
            elif action == "double":
                siblings.append(element)
            elif action == "swap":
                other = chance.choice(list(siblings))
                i, j = list(siblings).index(element), list(siblings).index(other)
                siblings[i], siblings[j] = other, element
    return ElementTree.tostring(root, encoding="unicode")


def survives(folder: Path, content: str | bytes) -> None:
    """Reading gives a description that can be used, or an error of the family that is more than its base."""
    try:
        about = read(folder, content)
    except FmuError as error:
        assert type(error) is not FmuError and len(str(error)) < 1000
        return
    assert len(about.states) == len(about.derivatives) == len(set(about.states))
    for group in (about.states, about.derivatives, about.inputs, about.outputs, about.parameters):
        assert all(about.variables[v.name] is v for v in group)
    assert all(v.nominal > 0 for v in about.variables.values())


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.integers(0, 4), seed=st.integers(0, 2**32))
def test_whatever_the_content_only_fmu_errors_come(descriptions, tmp_path, which, seed):
    """Attributes and elements of real descriptions dropped, replaced by hostile values, doubled and swapped."""
    survives(tmp_path, mutated(descriptions[which], random.Random(seed)))


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(which=st.integers(0, 4), flips=st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=4)), max_size=5))
def test_whatever_the_bytes_only_fmu_errors_come(descriptions, tmp_path, which, flips):
    """Bytes of real descriptions replaced, removed and added."""
    content = descriptions[which].encode()
    for place, new in flips:
        at = place % len(content)
        content = content[:at] + new + content[at + 2 :]
    survives(tmp_path, content)


# ---- the screen ----------------------------------------------------------------------------------------------------


def test_the_screen_tells_everything_within_its_width():
    """Kinds, platform, sources, experiment, start values, units and texts of every variable of the quadrotor."""
    text = describe(build("quadrotor", fmi=3))
    assert max(map(len, text.splitlines())) <= WIDTH
    for part in ("directional derivatives", "(this platform)", "quadrotor.c", "0 to 10 s", "682.276", "N.m.s2"):
        assert part in text
    assert "states (12)" in text and "tunable parameters (10)" in text and "coupling of body rates" in text


def test_the_screen_tells_what_is_missing(tmp_path):
    """No binary, no dependencies, arrays, and names too long for a column."""
    long = "a" * 150

    def change(text: str) -> str:
        text = text.replace("</ModelVariables>", ARRAY).replace('name="y_x0"', f'name="{long}"')
        root = ElementTree.fromstring(text)
        for unknown in root.findall("ModelStructure/Output"):
            unknown.attrib.pop("dependencies")
        return ElementTree.tostring(root, encoding="unicode")

    fmu = build("van_der_pol", fmi=3)
    text = describe(rewritten(fmu, tmp_path / "x.fmu", change=change, keep=lambda name: "binaries" not in name))
    assert "none for this platform" in text and "ctmhe fmu build" in text
    assert f"not declared for {long}" in text and "field: an array" in text
    assert f"\n  {long}\n" in text


def test_variables_are_values():
    """The screen and the models may share them."""
    with pytest.raises(AttributeError):
        Variable("a", 1, "local", "continuous", None, "", 1.0, None, None, None).name = "b"  # type: ignore[misc]
