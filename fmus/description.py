"""From the description of a model to the XML that its FMU carries, for FMI 2 and 3."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from fmus.variables import CO_SIMULATION, MODEL_EXCHANGE, RATE, UNITS, Description, Variable


@dataclass(frozen=True)
class _Scalar:
    """One variable of the model description, in the order of its value reference."""

    kind: str  # time, x, dx, u, p, y, z, q, s
    variable: Variable
    reference: int


def _scalars(model: Description) -> list[_Scalar]:
    """All variables in the order of their value references, which is that of `src/core.h`."""
    time = Variable("time", "s", None, 1.0, "simulation time")
    rates = [
        Variable(
            f"der({v.name})",
            RATE[v.unit],
            None,
            v.nominal if v.rate is None else v.rate,
            f"derivative of {v.name}",
            v.depends,
        )
        for v in model.states
    ]
    groups: list[tuple[str, Iterable[Variable]]] = [
        ("time", [time]),
        ("x", model.states),
        ("dx", rates),
        ("u", model.inputs),
        ("p", model.parameters),
        ("y", model.outputs),
        ("z", model.indicators),
        ("q", model.discretes),
        ("s", [] if model.structural is None else [model.structural]),
    ]
    scalars, reference = [], 0
    for kind, group in groups:
        for variable in group:
            scalars.append(_Scalar(kind, variable, reference))
            reference += variable.size
    return scalars


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


def _said(**attributes: bool) -> dict[str, str]:
    return {name: "true" if value else "false" for name, value in attributes.items()}


def _units(parent: ET.Element, scalars: list[_Scalar]) -> None:
    definitions = ET.SubElement(parent, "UnitDefinitions")
    for name in sorted({s.variable.unit for s in scalars if s.kind != "s"}):
        unit = ET.SubElement(definitions, "Unit", name=name)
        exponents = UNITS[name]
        ET.SubElement(unit, "BaseUnit", {k: repr(v) if k == "factor" else f"{v:g}" for k, v in exponents.items()})


def _experiment(parent: ET.Element, model: Description) -> None:
    ET.SubElement(parent, "DefaultExperiment", startTime="0.0", stopTime=repr(model.stop), stepSize=repr(model.step))


_CAUSALITY = {"time": "independent", "u": "input", "p": "parameter", "y": "output", "s": "structuralParameter"}
_INITIAL = {"x": "exact", "dx": "calculated", "p": "exact", "y": "calculated", "z": "calculated", "q": "calculated"}


def _attributes(model: Description, scalar: _Scalar) -> dict[str, str]:
    """What both versions say of a variable, outside its type."""
    kind = scalar.kind
    attributes = {
        "name": scalar.variable.name,
        "valueReference": str(scalar.reference),
        "description": scalar.variable.description,
        "causality": _CAUSALITY.get(kind, "local"),
        "variability": {"p": model.variability, "q": "discrete", "s": "fixed"}.get(kind, "continuous"),
    }
    return attributes | ({"initial": _INITIAL[kind]} if kind in _INITIAL else {})


def _value(scalar: _Scalar) -> dict[str, str]:
    """Unit, nominal and start value."""
    variable = scalar.variable
    value = {"unit": variable.unit}
    if scalar.kind != "time":
        value["nominal"] = repr(variable.nominal)
    if variable.start is not None and scalar.kind != "q":  # discrete variables cannot be set
        value["start"] = repr(variable.start)
    return value | (_said(reinit=True) if variable.reinit else {})


def _unknown(
    model: Description, scalars: list[_Scalar], scalar: _Scalar, knowns: tuple[str, ...], index: int
) -> dict[str, str]:
    """Dependencies on the kinds `knowns`: as references (FMI 3, index 0) or indices from 1 (FMI 2, index 1).

    FMI 3 counts tunable parameters as known in every mode, FMI 2 in initialization mode only. CasADi takes
    the sparsity of df/dx from here, and for FMI 3 that of df/dp: a parameter left out there has df/dp = 0 and
    its derivative leaks into df/dx.
    """
    own = {("valueReference", "index")[index]: str(scalar.reference + index)}
    if not model.dependencies:
        return own
    known = {s.variable.name: s.reference + index for s in scalars if s.kind in knowns}
    chosen = sorted(known[name] for name in scalar.variable.depends if name in known)
    return own | {"dependencies": " ".join(map(str, chosen))}


# ---- FMI 2 ----


def _kinds_2(model: Description) -> dict[str, dict[str, str]]:
    common = _said(
        canBeInstantiatedOnlyOncePerProcess=model.single_instance,
        canGetAndSetFMUstate=model.saves_state,
        canSerializeFMUstate=model.saves_state,
        providesDirectionalDerivative=model.directional_derivatives,
    )
    kinds = {
        MODEL_EXCHANGE: common | _said(completedIntegratorStepNotNeeded=not model.completed_steps),
        CO_SIMULATION: common | _said(canHandleVariableCommunicationStepSize=model.variable_step),
    }
    return {kind: {"modelIdentifier": model.name} | kinds[kind] for kind in model.kinds}


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
        numberOfEventIndicators=str(len(model.indicators)),
    )
    for kind, attributes in _kinds_2(model).items():
        files = ET.SubElement(ET.SubElement(root, kind, attributes), "SourceFiles")
        for name in sources:
            ET.SubElement(files, "File", name=name)
    _units(root, scalars)
    _experiment(root, model)
    variables = ET.SubElement(root, "ModelVariables")
    for scalar in scalars:
        element = ET.SubElement(variables, "ScalarVariable", _attributes(model, scalar))
        value = _value(scalar)
        if scalar.kind == "dx":
            value["derivative"] = str(scalar.reference - len(model.states) + 1)
        ET.SubElement(element, "Real", value)
    structure = ET.SubElement(root, "ModelStructure")
    for tag, unknowns, knowns in _STRUCTURE_2:
        group = ET.SubElement(structure, tag)
        for scalar in scalars:
            if scalar.kind in unknowns:
                ET.SubElement(group, "Unknown", _unknown(model, scalars, scalar, knowns, 1))
    return root


# ---- FMI 3 ----


def _kinds_3(model: Description) -> dict[str, dict[str, str]]:
    common = _said(
        canBeInstantiatedOnlyOncePerProcess=model.single_instance,
        canGetAndSetFMUState=model.saves_state,
        canSerializeFMUState=model.saves_state,
        providesDirectionalDerivatives=model.directional_derivatives,
        providesAdjointDerivatives=model.directional_derivatives,
    )
    step = {} if model.variable_step else {"fixedInternalStepSize": repr(model.step)}
    kinds = {
        MODEL_EXCHANGE: common | _said(needsCompletedIntegratorStep=model.completed_steps),
        CO_SIMULATION: common
        | _said(canHandleVariableCommunicationStepSize=model.variable_step, hasEventMode=model.has_events)
        | step,
    }
    return {kind: {"modelIdentifier": model.name} | kinds[kind] for kind in model.kinds}


_STRUCTURE_3 = (
    ("Output", "y"),
    ("ContinuousStateDerivative", "dx"),
    ("InitialUnknown", "dx"),
    ("InitialUnknown", "y"),
    ("EventIndicator", "z"),
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
    for kind, attributes in _kinds_3(model).items():
        ET.SubElement(root, kind, attributes)
    _units(root, scalars)
    _experiment(root, model)
    variables = ET.SubElement(root, "ModelVariables")
    for scalar in scalars:
        _variable_3(variables, model, scalar)
    structure = ET.SubElement(root, "ModelStructure")
    for tag, kind in _STRUCTURE_3:
        for scalar in scalars:
            if scalar.kind == kind:
                ET.SubElement(structure, tag, _unknown(model, scalars, scalar, ("x", "u", "p"), 0))
    return root


def _variable_3(parent: ET.Element, model: Description, scalar: _Scalar) -> None:
    attributes = _attributes(model, scalar)
    if scalar.kind == "s":
        ET.SubElement(parent, "UInt64", attributes | {"start": f"{scalar.variable.start:.0f}"})
        return
    attributes |= _value(scalar)
    if scalar.kind == "dx":
        attributes["derivative"] = str(scalar.reference - len(model.states))
    element = ET.SubElement(parent, "Float64", attributes)
    if scalar.variable.size > 1:
        ET.SubElement(element, "Dimension", start=str(scalar.variable.size))
