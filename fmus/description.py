"""From the description of a model to what its FMU carries: modelDescription.xml (FMI 2 and 3), config.h."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from fmus.models import RATE, UNITS, Description, Variable


@dataclass(frozen=True)
class _Scalar:
    """One variable of the model description, in the order of its value reference."""

    kind: str  # time, x, dx, u, p, y
    variable: Variable
    reference: int


def _scalars(model: Description) -> list[_Scalar]:
    """All variables; value reference = position: time, x, dx, u, p, y (the order of `src/core.h`)."""
    time = Variable("time", "s", None, 1.0, "simulation time")
    rates = [
        Variable(f"der({v.name})", RATE[v.unit], None, v.nominal, f"derivative of {v.name}", v.depends)
        for v in model.states
    ]
    groups: list[tuple[str, Iterable[Variable]]] = [
        ("time", [time]),
        ("x", model.states),
        ("dx", rates),
        ("u", model.inputs),
        ("p", model.parameters),
        ("y", model.outputs),
    ]
    pairs = [(kind, variable) for kind, group in groups for variable in group]
    return [_Scalar(kind, variable, k) for k, (kind, variable) in enumerate(pairs)]


def config_header(model: Description, token: str) -> str:
    """Return the text of config.h: sizes, names of indices, start and nominal values, token."""
    groups = {"X": model.states, "U": model.inputs, "P": model.parameters, "Y": model.outputs}
    lines = ["/* Generated from fmus/models.py: do not edit. */", f'#define MODEL_TOKEN "{token}"']
    lines.append(f"#define STIFF {int(model.stiff)}")
    lines += [f"#define N{letter} {len(group)}" for letter, group in groups.items()]
    for letter, group in groups.items():
        lines.append(f"enum {{ {', '.join(f'{letter}_{v.name}' for v in group)} }};")
        if letter != "Y":
            lines.append(f"#define {letter}_START {{ {', '.join(repr(v.start) for v in group)} }}")
    lines.append(f"#define X_NOMINAL {{ {', '.join(repr(v.nominal) for v in model.states)} }}")
    return "\n".join(lines) + "\n"


def model_description(model: Description, fmi: int, token: str, sources: Iterable[str]) -> str:
    """Return the text of modelDescription.xml for FMI `fmi` (2 or 3)."""
    root = _fmi2(model, token, list(sources)) if fmi == 2 else _fmi3(model, token)
    return _text(root)


def build_description(model: Description, sources: Iterable[str]) -> str:
    """Return the text of sources/buildDescription.xml (FMI 3.0)."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=model.name)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        ET.SubElement(files, "SourceFile", name=name)
    return _text(root)


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _units(parent: ET.Element, scalars: list[_Scalar]) -> None:
    definitions = ET.SubElement(parent, "UnitDefinitions")
    for name in sorted({s.variable.unit for s in scalars}):
        unit = ET.SubElement(definitions, "Unit", name=name)
        exponents = {"s": 1.0} if name == "s" else UNITS[name]
        ET.SubElement(unit, "BaseUnit", {k: repr(v) if k == "factor" else f"{v:g}" for k, v in exponents.items()})


def _experiment(parent: ET.Element, model: Description) -> None:
    ET.SubElement(parent, "DefaultExperiment", startTime="0.0", stopTime=repr(model.stop), stepSize=repr(model.step))


_CAUSALITY = {
    "time": "independent",
    "x": "local",
    "dx": "local",
    "u": "input",
    "p": "parameter",
    "y": "output",
}


def _attributes(scalar: _Scalar) -> dict[str, str]:
    """What both versions say of a variable, outside its type."""
    attributes = {
        "name": scalar.variable.name,
        "valueReference": str(scalar.reference),
        "description": scalar.variable.description,
        "causality": _CAUSALITY[scalar.kind],
        "variability": "tunable" if scalar.kind == "p" else "continuous",
    }
    initial = {"x": "exact", "dx": "calculated", "p": "exact", "y": "calculated"}.get(scalar.kind)
    return attributes | ({"initial": initial} if initial else {})


def _value(scalar: _Scalar) -> dict[str, str]:
    """Unit, nominal and start value."""
    variable = scalar.variable
    value = {"unit": variable.unit}
    if scalar.kind != "time":
        value["nominal"] = repr(variable.nominal)
    return value | ({} if variable.start is None else {"start": repr(variable.start)})


def _dependencies(scalars: list[_Scalar], scalar: _Scalar, knowns: tuple[str, ...], index: int) -> dict[str, str]:
    """Dependencies on the kinds `knowns`: as references (FMI 3, index 0) or indices from 1 (FMI 2, index 1).

    FMI 3 counts tunable parameters as known in every mode, FMI 2 in initialization mode only. CasADi takes
    the sparsity of df/dx from here, and for FMI 3 that of df/dp: a parameter left out there has df/dp = 0 and
    its derivative leaks into df/dx.
    """
    known = {s.variable.name: s.reference + index for s in scalars if s.kind in knowns}
    chosen = sorted(known[name] for name in scalar.variable.depends if name in known)
    return {"dependencies": " ".join(map(str, chosen))}


_COMMON_2 = {
    "canGetAndSetFMUstate": "true",
    "canSerializeFMUstate": "true",
    "providesDirectionalDerivative": "true",
}


_STRUCTURE_2 = (
    ("Outputs", ("y",), ("x", "u")),
    ("Derivatives", ("dx",), ("x", "u")),
    ("InitialUnknowns", ("dx", "y"), ("x", "u", "p")),
)


def _fmi2(model: Description, token: str, sources: list[str]) -> ET.Element:
    scalars = _scalars(model)
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=model.name,
        guid=token,
        description=model.description,
        generationTool="ctmhe",
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    kinds = {
        "ModelExchange": {"completedIntegratorStepNotNeeded": "true"},
        "CoSimulation": {"canHandleVariableCommunicationStepSize": "true"},
    }
    for kind, special in kinds.items():
        element = ET.SubElement(root, kind, {"modelIdentifier": model.name} | special | _COMMON_2)
        files = ET.SubElement(element, "SourceFiles")
        for name in sources:
            ET.SubElement(files, "File", name=name)
    _units(root, scalars)
    _experiment(root, model)
    variables = ET.SubElement(root, "ModelVariables")
    for scalar in scalars:
        element = ET.SubElement(variables, "ScalarVariable", _attributes(scalar))
        value = _value(scalar)
        if scalar.kind == "dx":
            value["derivative"] = str(scalar.reference - len(model.states) + 1)
        ET.SubElement(element, "Real", value)
    structure = ET.SubElement(root, "ModelStructure")
    for tag, unknowns, knowns in _STRUCTURE_2:
        group = ET.SubElement(structure, tag)
        for scalar in scalars:
            if scalar.kind in unknowns:
                known = {"index": str(scalar.reference + 1)} | _dependencies(scalars, scalar, knowns, 1)
                ET.SubElement(group, "Unknown", known)
    return root


_COMMON_3 = {
    "canGetAndSetFMUState": "true",
    "canSerializeFMUState": "true",
    "providesDirectionalDerivatives": "true",
    "providesAdjointDerivatives": "true",
}


_STRUCTURE_3 = (
    ("Output", "y"),
    ("ContinuousStateDerivative", "dx"),
    ("InitialUnknown", "dx"),
    ("InitialUnknown", "y"),
)


def _fmi3(model: Description, token: str) -> ET.Element:
    scalars = _scalars(model)
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=model.name,
        instantiationToken=token,
        description=model.description,
        generationTool="ctmhe",
        variableNamingConvention="structured",
    )
    kinds = {
        "ModelExchange": {"needsCompletedIntegratorStep": "false"},
        "CoSimulation": {"canHandleVariableCommunicationStepSize": "true"},
    }
    for kind, special in kinds.items():
        ET.SubElement(root, kind, {"modelIdentifier": model.name} | special | _COMMON_3)
    _units(root, scalars)
    _experiment(root, model)
    variables = ET.SubElement(root, "ModelVariables")
    for scalar in scalars:
        attributes = _attributes(scalar) | _value(scalar)
        if scalar.kind == "dx":
            attributes["derivative"] = str(scalar.reference - len(model.states))
        ET.SubElement(variables, "Float64", attributes)
    structure = ET.SubElement(root, "ModelStructure")
    for tag, kind in _STRUCTURE_3:
        for scalar in scalars:
            if scalar.kind == kind:
                known = {"valueReference": str(scalar.reference)} | _dependencies(scalars, scalar, ("x", "u", "p"), 0)
                ET.SubElement(structure, tag, known)
    return root
