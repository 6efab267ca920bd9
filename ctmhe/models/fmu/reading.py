"""From modelDescription.xml of FMI 2.0 and 3.x to a `Description`; whatever is wrong in it is a typed error."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ctmhe.errors import FmuArchiveError, FmuVersionError
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, Interface, Variable
from ctmhe.models.fmu.markup import Element, Reader, parse
from ctmhe.models.fmu.sources import read_sources
from ctmhe.models.fmu.structure import (
    REAL,
    Raw,
    check_shared,
    dynamics,
    read_structure,
    read_variables,
    unsupported_variables,
)
from ctmhe.models.fmu.units import BASE, Unit

COMPLAINTS = {f"logStatus{status}" for status in ("Warning", "Discard", "Error", "Fatal")}
INITIALS = {"exact", "approx", "calculated"}
MAX_INDICATORS = 1_000_000  # FMI 2 states a number that nothing else in the file confirms


def read_description(folder: Path) -> Description:
    """Read modelDescription.xml of an unpacked FMU, and sources/buildDescription.xml if there is one.

    Parameters
    ----------
    folder : Path
        Where the FMU is unpacked.

    Raises
    ------
    FmuVersionError
        If the FMI version is neither 2.0 nor 3.x.
    FmuArchiveError
        If a file cannot be parsed or its content is inconsistent; with variable and attribute.
    """
    root = parse(folder / "modelDescription.xml", "fmiModelDescription")
    version = _version(root)
    major = int(version[0])
    top = Reader(root, "the model")
    kinds = _kinds(root, major)
    raws = read_variables(root, major)
    structure = read_structure(root, major, raws)
    remarks: list[str] = []
    variables, own = _reals(root, major, raws, remarks)
    try:
        states, derivatives, unsupported = dynamics(structure["derivatives"], major, raws)
    except FmuArchiveError as error:
        if MODEL_EXCHANGE in kinds:
            raise
        # a co-simulation integrates itself, and does without them
        remarks.append(f"what it says of its derivatives is of no use ({error}), so it has no states")
        states, derivatives, unsupported = [], [], {}
    unsupported = unsupported_variables(raws, structure) | unsupported
    inputs = [raw for raw in own if raw.causality == "input"]
    if major == 2:
        check_shared([*states, *inputs])
    indicators = top.whole("numberOfEventIndicators", MAX_INDICATORS) if major == 2 else len(structure["indicators"])
    experiment = _experiment(root, remarks)
    return Description(
        version=version,
        name=top.required("modelName"),
        tool=top.text("generationTool"),
        token=_token(top, major),
        kinds=kinds,
        variables=variables,
        states=tuple(variables[raw.name] for raw in states),
        derivatives=tuple(variables[raw.name] for raw in derivatives),
        inputs=tuple(variables[raw.name] for raw in inputs),
        outputs=tuple(variables[raw.name] for raw in own if raw.causality == "output"),
        parameters=tuple(
            variables[raw.name]
            for raw in own
            if raw.causality == "parameter" and raw.variability in {"fixed", "tunable"}
        ),
        event_indicators=indicators or 0,
        unsupported=unsupported,
        dependencies={
            unknown.variable.name: unknown.dependencies
            for group in ("derivatives", "outputs")
            for unknown in structure[group]
            if unknown.variable.name in variables
        },
        units=_units(root),
        platforms=_platforms(folder),
        sources=read_sources(root, folder, major, kinds),
        description=top.text("description"),
        complaints=tuple(
            element.get("name", "")
            for element in root.findall("LogCategories/Category")
            if element.get("name") in COMPLAINTS
        ),
        remarks=tuple(remarks),
        **experiment,
    )


def _version(root: Element) -> str:
    version = root.get("fmiVersion", "")
    if version == "2.0" or re.fullmatch(r"3\.\d{1,4}(\.\d{1,4})?", version, re.ASCII):
        return version
    told = repr(version[:40]) if version else "unknown"
    raise FmuVersionError(f"FMI version {told} is not supported; export the FMU as FMI 2.0 or 3.0")


def _token(top: Reader, major: int) -> str:
    name = "guid" if major == 2 else "instantiationToken"
    token = top.element.get(name)
    if token is None:
        raise top.fail(name, "which the binary checks")
    return token


def _kinds(root: Element, major: int) -> dict[str, Interface]:
    kinds = {}
    for kind in (MODEL_EXCHANGE, CO_SIMULATION):
        elements = root.findall(kind)
        if len(elements) > 1:
            raise FmuArchiveError(f"modelDescription.xml: <{kind}> is there {len(elements)} times; export it again")
        for element in elements:
            kinds[kind] = _interface(Reader(element, kind), major, kind)
    return kinds


def _interface(reader: Reader, major: int, kind: str) -> Interface:
    identifier = reader.required("modelIdentifier")
    if re.search(r"[/\\:\x00-\x1f]|^\.", identifier):  # it becomes the name of a file that is loaded
        raise reader.fail("modelIdentifier", "expected a name")
    fixed = reader.number("fixedInternalStepSize", finite=True) if major == 3 else None
    if fixed is not None and fixed <= 0:
        raise reader.fail("fixedInternalStepSize", "expected a positive number")
    if major == 2:
        state, directional = "canGetAndSetFMUstate", "providesDirectionalDerivative"
        completed = not reader.truth("completedIntegratorStepNotNeeded")
    else:
        state, directional = "canGetAndSetFMUState", "providesDirectionalDerivatives"
        completed = reader.truth("needsCompletedIntegratorStep")
    return Interface(
        identifier=identifier,
        directional_derivatives=reader.truth(directional),
        get_set_state=reader.truth(state),
        single_instance=reader.truth("canBeInstantiatedOnlyOncePerProcess"),
        completed_step=kind == MODEL_EXCHANGE and completed,
        variable_step=kind == MODEL_EXCHANGE or reader.truth("canHandleVariableCommunicationStepSize"),
        needs_tool=reader.truth("needsExecutionTool"),
        event_mode=reader.truth("hasEventMode"),
        early_return=reader.truth("mightReturnEarlyFromDoStep"),
        fixed_step=fixed,
        input_derivatives=reader.truth("canInterpolateInputs"),
    )


def _reals(root: Element, major: int, raws: Sequence[Raw], remarks: list[str]) -> tuple[dict[str, Variable], list[Raw]]:
    """Return real scalars by name, with the alias names of FMI 3, and those that are no such alias."""
    types = _types(root, major)
    variables: dict[str, Variable] = {}
    own: list[Raw] = []
    names: set[str] = set()
    for raw in raws:
        declared = raw.value.text("declaredType")
        if declared and (declared not in types or not _fits(types[declared].element.tag, raw.type)):
            raise raw.value.fail("declaredType", f"which is no type of {raw.type} variables")
        variable = None
        if raw.type == REAL[major] and not raw.array and raw.causality != "structuralParameter":
            variable = _variable(raw, types.get(declared), remarks)
            own.append(raw)
        for name, text in _names(raw, major):
            if name in names:
                raise FmuArchiveError(f"modelDescription.xml: two variables are named {name[:100]!r}; export it again")
            names.add(name)
            if variable is not None and name == raw.name:
                variables[name] = variable
            elif variable is not None:
                variables[name] = replace(variable, name=name, description=text or variable.description)
    return variables, own


def _names(raw: Raw, major: int) -> Iterator[tuple[str, str]]:
    """Yield the names of a variable, its own first, with their descriptions."""
    yield raw.name, raw.reader.text("description")
    if major == 3:
        for element in raw.reader.element.findall("Alias"):
            alias = replace(raw.reader, element=element, owner=f"alias of {raw.reader.owner}")
            yield alias.required("name"), alias.text("description")


def _types(root: Element, major: int) -> dict[str, Reader]:
    """Return the type definitions: readers of the element that has unit, nominal and limits."""
    types = {}
    for definition in root.findall("TypeDefinitions/*"):
        name = Reader(definition, "a type definition").required("name")
        if name in types:
            raise FmuArchiveError(f"modelDescription.xml: two types are named {name[:100]!r}; export the FMU again")
        element = next(iter(definition), definition) if major == 2 else definition
        types[name] = Reader(element, f"type {name[:100]!r}")
    return types


def _fits(tag: str, type: str) -> bool:
    return tag.removesuffix("Type") == type


def _variable(raw: Raw, declared: Reader | None, remarks: list[str]) -> Variable:
    def number(attribute: str, *, nan: bool = False) -> float | None:
        own = raw.value.number(attribute, nan=nan)
        return declared.number(attribute, nan=nan) if own is None and declared is not None else own

    nominal = number("nominal", nan=True)
    if nominal is not None and not (math.isfinite(nominal) and nominal >= sys.float_info.min):
        remarks.append(f"the nominal value {nominal:g} of {raw.name!r} is of no use, 1 is taken")
        nominal = None
    minimum, maximum = number("min"), number("max")
    if minimum is not None and maximum is not None and minimum > maximum:
        raise raw.value.fail("min", f"above the maximum {maximum}")
    raw.value.truth("reinit")
    return Variable(
        name=raw.name,
        reference=raw.reference,
        causality=raw.causality,
        variability=raw.variability,
        initial=_initial(raw),
        unit=raw.value.text("unit") or (declared.text("unit") if declared is not None else ""),
        nominal=1.0 if nominal is None else nominal,
        start=raw.value.number("start"),
        minimum=minimum,
        maximum=maximum,
        description=raw.reader.text("description"),
    )


def _initial(raw: Raw) -> str | None:
    """Return `initial`, or what the standards take where it is not given: nothing for inputs and time."""
    if raw.reader.element.get("initial") is None and raw.causality in {"input", "independent"}:
        return None
    given = raw.causality == "parameter" or raw.variability == "constant"
    return raw.reader.word("initial", INITIALS, "exact" if given else "calculated")


def _units(root: Element) -> dict[str, Unit]:
    units: dict[str, Unit] = {}
    names: set[str] = set()
    for element in root.findall("UnitDefinitions/Unit"):
        name = element.get("name")
        if not name:  # some tools define one for variables without a unit
            continue
        if name in names:
            raise FmuArchiveError(f"modelDescription.xml: two units are named {name[:100]!r}; export the FMU again")
        names.add(name)
        base = element.find("BaseUnit")
        if base is None:
            continue  # it cannot be converted, and need not be
        reader = Reader(base, f"unit {name[:100]!r}")
        exponents = {key: reader.number(key, finite=True) or 0.0 for key in BASE}
        for key, exponent in exponents.items():
            if not exponent.is_integer():
                raise reader.fail(key, "expected a whole number")
        factor, offset = reader.number("factor", finite=True), reader.number("offset", finite=True)
        if factor == 0:
            raise reader.fail("factor", "expected another number")
        units[name] = Unit(tuple(map(int, exponents.values())), 1.0 if factor is None else factor, offset or 0.0)
    return units


def _experiment(root: Element, remarks: list[str]) -> dict[str, float | None]:
    """Return the default experiment; step and tolerance are None where they are of no use."""
    element = root.find("DefaultExperiment")
    reader = Reader(root if element is None else element, "DefaultExperiment")
    names = {"start_time": "startTime", "stop_time": "stopTime", "step": "stepSize", "tolerance": "tolerance"}
    found = {key: reader.number(name, finite=True) for key, name in names.items()}
    for key in ("step", "tolerance"):
        value = found[key]
        if value is not None and value <= 0:
            remarks.append(f"the default experiment's {names[key]} {value:g} is of no use")
            found[key] = None
    return found


def _platforms(folder: Path) -> tuple[str, ...]:
    binaries = folder / "binaries"
    return tuple(sorted(path.name for path in binaries.iterdir() if path.is_dir())) if binaries.is_dir() else ()
