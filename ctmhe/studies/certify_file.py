"""A certificate from a TOML file: the model, the domain, what is asked for; and as a text to read."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.certificates import DetectabilityCertificate, certify_detectability
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model, box_arrays
from ctmhe.studies.described import LIBRARY, build_model
from ctmhe.studies.tables import MODEL, box_of, check_keys, read_toml, table_of
from ctmhe.types import Array, Bounds

TABLES = ("model", "domain", "certificate")
ASKED = ("eta", "rate", "objective", "P", "Q", "R", "seed")
USED = ("horizon", "wait")


@dataclass(frozen=True, eq=False)
class Certified:
    """What a file asked for, and what came of it."""

    model: Model
    certificate: DetectabilityCertificate
    horizon: float | None = None
    wait: float | None = None


def certify_file(path: Path) -> Certified:
    """Read a file and compute its certificate.

    Parameters
    ----------
    path : Path
        TOML: [model] with `model` and `options` of the library, or `fmu` and what `FmuModel` takes; [domain] with boxes
        x, u, w, p, a pair or a table of pairs, the model's own when left out; [certificate] with arguments of
        `certify_detectability`, and `horizon` and `wait` for the report, in
        seconds, or steps of a discrete model.

    Raises
    ------
    InputError
        For what cannot be read, unknown keys and wrong values; file and table are named.
    CertificateError
        If there is no certificate.
    """
    path, where = Path(path), str(path)
    content = read_toml(path)
    check_keys(content, TABLES, where)
    about, boxes, asked = (table_of(content, name, where) for name in TABLES)
    if ("model" in about) == ("fmu" in about):
        raise InputError(f"{where}: table [model] needs model (of the library) or fmu (a path), and not both")
    check_keys(about, ("fmu", *MODEL) if "fmu" in about else LIBRARY, f"{where}: table [model]")
    check_keys(boxes, "xuwp", f"{where}: table [domain]")
    check_keys(asked, (*ASKED, *USED), f"{where}: table [certificate]")
    if "fmu" in about:
        about["fmu"] = str(path.parent / str(about["fmu"]))
    model = build_model(about)
    horizon, wait = (_seconds(asked.pop(key, None), f"{where}: [certificate] {key}") for key in USED)
    domain = Bounds(**{key: box_of(boxes[key]) if key in boxes else getattr(model.bounds, key) for key in "xwp"})
    u = box_of(boxes["u"]) if "u" in boxes else None
    return Certified(model, certify_detectability(model, domain, u=u, **asked), horizon, wait)


def report(found: Certified) -> str:
    """Return the certificate as text: what, where, how rigorous, horizon, rate, longest wait."""
    model, made = found.model, found.certificate
    unit = "steps" if model.step else "s"
    per = f"step of {model.step:g} s" if model.step else "second"
    wait = found.wait or 0.0
    rows = [
        f"{model.name}: detectable, with a quadratic i-{'' if model.step else 'i'}IOSS Lyapunov function",
        "",
        f"rate      eta = {made.eta:.6g} per {per}: U fades by half in {np.log(2) / -np.log(made.eta):.4g} {unit}",
        f"proof     {'yes' if made.rigorous else 'no, evidence only'}; domain covered by: {made.method}",
        f"margin    {made.margin:.3g} at fresh points, the least at {_point(made)}",
        f"horizon   longer than {made.shortest_horizon(wait=wait):.5g} {unit}, samples at most {wait:g} {unit} apart",
    ]
    if found.horizon is not None:
        rows.append(
            f"T = {found.horizon:g} {unit}: samples may be up to {made.longest_wait(found.horizon):.4g} {unit} apart"
        )
        rho = made.contraction(found.horizon, wait=wait) if found.horizon > wait else np.inf
        said = (
            f"the squared error in U contracts by rho = {rho:.5g} per {per}" if rho < 1 else "no guarantee (rho >= 1)"
        )
        rows.append(f"          {said}, waits up to {wait:g} {unit}")
    rows += ["", "domain"]
    for key in ("x", "w", "p"):
        box = getattr(made.domain, key) if made.domain is not None else None
        rows += [f"  {line}" for line in _box(getattr(model, key), box)]
    for name in ("P_lower", "P_upper") if made.ratio > 1 + 1e-9 else ("P_lower",):
        rows += ["", name if made.ratio > 1 + 1e-9 else "P", _matrix(getattr(made, name))]
    rows += ["", "Q", _matrix(made.Q), "", "R", _matrix(made.R)]
    if made.notes:
        rows += ["", *(textwrap.fill(f"- {note}", 100, subsequent_indent="  ") for note in made.notes)]
    return "\n".join(rows)


def as_json(found: Certified) -> dict[str, Any]:
    """Return the certificate's numbers, for a file."""
    made = found.certificate
    matrices = {name: getattr(made, name).tolist() for name in ("P_lower", "P_upper", "Q", "R")}
    numbers = {"eta": made.eta, "step": made.step, "margin": made.margin, "worst": dict(made.worst or {})}
    said = {"method": made.method, "rigorous": made.rigorous, "notes": list(made.notes)}
    return {"model": found.model.name, **matrices, **numbers, **said, "t_min": made.shortest_horizon()}


def _point(made: DetectabilityCertificate) -> str:
    shown = ", ".join(f"{name} = {value:.4g}" for name, value in list((made.worst or {}).items())[:6])
    return shown + (", ..." if len(made.worst or {}) > 6 else "")


def _box(signals: Any, box: Any) -> list[str]:
    lower, upper = box_arrays(signals, box, "domain")
    return [
        f"{name} any" if np.isinf([a, b]).all() else f"{a:g} <= {name} <= {b:g}"
        for name, a, b in zip(signals.names, lower, upper, strict=True)
    ]


def _matrix(matrix: Array) -> str:
    with np.printoptions(precision=5, suppress=False, linewidth=110):
        return textwrap.indent(str(np.asarray(matrix)), "  ")


def _seconds(value: Any, where: str) -> float | None:
    if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= 0):
        raise InputError(f"{where} must be a number >= 0, got {value!r}")
    return None if value is None else float(value)
