"""Variables of every type as modelDescription.xml lists them, and the structure of the model: what refers to what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ctmhe.errors import FmuArchiveError
from ctmhe.models.fmu.markup import Element, Reader

TYPES = {
    2: ("Real", "Integer", "Boolean", "String", "Enumeration"),
    3: (
        *("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64"),
        *("Boolean", "String", "Binary", "Enumeration", "Clock"),
    ),
}
REAL = {2: "Real", 3: "Float64"}
# where ModelStructure lists what; initial unknowns and clocked states are only checked
STRUCTURE = {
    2: {"derivatives": "Derivatives/Unknown", "outputs": "Outputs/Unknown", "others": "InitialUnknowns/Unknown"},
    3: {
        "derivatives": "ContinuousStateDerivative",
        "outputs": "Output",
        "others": "InitialUnknown",
        "clocked": "ClockedState",
        "indicators": "EventIndicator",
    },
}
PARAMETERS = {"parameter", "calculatedParameter", "structuralParameter"}
VARIABILITIES = {"constant", "fixed", "tunable", "discrete", "continuous"}
LEGAL = {key: {"fixed", "tunable"} for key in PARAMETERS} | {  # causality -> variabilities
    "input": {"discrete", "continuous"},
    "output": {"constant", "discrete", "continuous"},
    "local": VARIABILITIES,
    "independent": {"continuous"},
}


@dataclass(frozen=True)
class Raw:
    """A variable of any type; `value` reads what FMI 2 keeps in an element of its own, such as start and unit."""

    reader: Reader
    value: Reader
    name: str
    reference: int
    type: str
    causality: str
    variability: str
    array: bool


@dataclass(frozen=True)
class Unknown:
    """An entry of ModelStructure."""

    reader: Reader
    variable: Raw
    dependencies: tuple[str, ...] | None


def read_variables(root: Element, major: int) -> list[Raw]:
    """Return the variables of every type, in the order of the file."""
    raws = [_raw(element, major) for element in _only(root, "ModelVariables")]
    if not raws:
        raise FmuArchiveError("modelDescription.xml lists no variables; export the FMU again")
    if major == 3:
        owners: dict[int, str] = {}
        for raw in raws:
            other = owners.setdefault(raw.reference, raw.name)
            if other != raw.name:
                raise raw.reader.fail("valueReference", f"which is that of {other!r} too")
    independent = [raw.name for raw in raws if raw.causality == "independent"]
    if len(independent) > 1:
        raise FmuArchiveError(
            f"modelDescription.xml: variables {independent[0]!r} and {independent[1]!r} both have causality "
            "independent, which only time can have; export the FMU again"
        )
    return raws


def _only(root: Element, tag: str) -> Element:
    found = root.findall(tag)
    if len(found) != 1:
        count = f"{len(found)} elements" if found else "no element"
        raise FmuArchiveError(f"modelDescription.xml has {count} <{tag}>, expected one; export the FMU again")
    return found[0]


def _raw(element: Element, major: int) -> Raw:
    name = element.get("name", "")
    reader = Reader(element, f"variable {name[:100]!r}")
    reader.required("name")
    types = [child for child in element if child.tag in TYPES[2]] if major == 2 else [element]
    known = len(types) == 1 and types[0].tag in TYPES[major] and (major == 3 or element.tag == "ScalarVariable")
    if not known:
        raise FmuArchiveError(
            f"modelDescription.xml: {reader.owner} has no type that FMI {major} knows; export it again"
        )
    causality = reader.word("causality", LEGAL, "local")
    variability = reader.word("variability", VARIABILITIES, "fixed" if causality in PARAMETERS else "continuous")
    if variability not in LEGAL[causality]:
        raise reader.fail("variability", f"which a variable of causality {causality} cannot have")
    return Raw(
        reader,
        Reader(types[0], reader.owner),
        name,
        reader.reference("valueReference"),
        types[0].tag,
        causality,
        variability,
        major == 3 and element.find("Dimension") is not None,
    )


def read_structure(root: Element, major: int, raws: Sequence[Raw]) -> dict[str, list[Unknown]]:
    """Return the entries of ModelStructure by group; raise for a reference to nothing or a repeated entry."""
    parent = _only(root, "ModelStructure")
    known = dict(enumerate(raws, start=1)) if major == 2 else {raw.reference: raw for raw in raws}
    attribute = "index" if major == 2 else "valueReference"
    groups: dict[str, list[Unknown]] = {}
    for group, path in STRUCTURE[major].items():
        entries = groups[group] = []
        seen: set[str] = set()
        for element in parent.findall(path):
            reader = Reader(element, path.replace("/Unknown", ""))
            variable = known.get(reader.reference(attribute))
            if variable is None:
                raise reader.fail(attribute, "which no variable has")
            if variable.name in seen and group != "others":  # repeated initial unknowns do no harm
                raise reader.fail(attribute, f"and so lists {variable.name!r} twice")
            seen.add(variable.name)
            entries.append(Unknown(reader, variable, _dependencies(reader, variable, known)))
    return groups


def _dependencies(reader: Reader, variable: Raw, known: Mapping[int, Raw]) -> tuple[str, ...] | None:
    named = replace(reader, owner=f"{reader.owner} of {variable.name[:100]!r}")
    references = named.references("dependencies")
    if references is None:
        return None
    missing = next((reference for reference in references if reference not in known), None)
    if missing is not None:
        raise named.fail("dependencies", f"where {missing} is no variable")
    return tuple(known[reference].name for reference in references)


def dynamics(
    unknowns: Sequence[Unknown], major: int, raws: Sequence[Raw]
) -> tuple[list[Raw], list[Raw], dict[str, str]]:
    """Return states and their derivatives in the same order, and those of them that are no scalars of double type."""
    known = dict(enumerate(raws, start=1)) if major == 2 else {raw.reference: raw for raw in raws}
    states: list[Raw] = []
    derivatives: list[Raw] = []
    unsupported: dict[str, str] = {}
    owners: dict[str, str] = {}
    for unknown in unknowns:
        derivative = unknown.variable
        number = derivative.value.whole("derivative")
        if number is None:
            raise derivative.value.fail("derivative", "although it is listed as a derivative of a state")
        state = known.get(number)
        if state is None or state is derivative:
            raise derivative.value.fail("derivative", "which is no state")
        if state.causality not in {"local", "output"} or state.variability != "continuous":
            raise derivative.value.fail(
                "derivative", f"but {state.name!r} is {state.variability} and {state.causality}, not a continuous state"
            )
        other = owners.setdefault(state.name, derivative.name)
        if other != derivative.name:
            raise derivative.value.fail("derivative", f"but {other!r} is the derivative of {state.name!r} already")
        foes = {raw.name: _foe(raw, REAL[major]) for raw in (state, derivative)}
        unsupported |= {name: foe for name, foe in foes.items() if foe}
        if not any(foes.values()):
            states.append(state)
            derivatives.append(derivative)
    return states, derivatives, unsupported


def _foe(raw: Raw, real: str) -> str:
    """Return what keeps a variable from being a state or a derivative; empty when nothing does."""
    return "an array" if raw.array else "" if raw.type == real else f"a state or derivative of type {raw.type}"


def unsupported_variables(raws: Sequence[Raw], structure: Mapping[str, Sequence[Unknown]]) -> dict[str, str]:
    """Return structural parameters, and arrays that an estimator or a plant would meet, with the reason."""
    listed = {unknown.variable.name for unknown in structure.get("indicators", ())}
    found = {}
    for raw in raws:
        if raw.causality == "structuralParameter":
            found[raw.name] = "a structural parameter"
        elif raw.array and (raw.causality in {"input", "output", "parameter"} or raw.name in listed):
            found[raw.name] = "an array"
    return found


def check_shared(raws: Sequence[Raw]) -> None:
    """Raise when two states or inputs are one: setting one of them would set the other."""
    owners: dict[int, str] = {}
    for raw in raws:
        other = owners.setdefault(raw.reference, raw.name)
        if other != raw.name:
            raise raw.reader.fail("valueReference", f"which is that of {other!r} too, and both are states or inputs")
