"""config.h: what the C sources know of a model's description."""

from __future__ import annotations

from collections.abc import Iterable

from fmus.variables import CO_SIMULATION, DEFECTS, MODEL_EXCHANGE, Description, Variable


def config_header(model: Description, token: str) -> str:
    """Return the text of config.h: sizes, names of indices, start and nominal values, token, flags."""
    structural = () if model.structural is None else (model.structural,)
    groups = {
        "X": model.states,
        "U": model.inputs,
        "P": model.parameters,
        "Y": (*model.outputs, *model.indicators),
        "Q": (*model.discretes, *structural),
    }
    lines = ["/* Generated from fmus/models.py: do not edit. */", f'#define MODEL_TOKEN "{token}"']
    for letter, group in groups.items():
        lines.append(f"#define N{letter} {sum(v.size for v in group)}")
        lines += _indices(letter, group, len(model.outputs))
        if letter != "Y":
            lines.append(f"#define {letter}_START {_values(v.start for v in group)}")
    lines.append(f"#define NZ {len(model.indicators)}")
    lines.append(f"#define X_NOMINAL {_values(v.nominal for v in model.states)}")
    lines += [f"#define {name} {value}" for name, value in _flags(model).items()]
    return "\n".join(lines) + "\n"


def _indices(letter: str, group: tuple[Variable, ...], outputs: int) -> list[str]:
    """Lines that name the first index of each variable; event indicators follow the outputs and begin with Z."""
    names, at = [], 0
    for k, variable in enumerate(group):
        prefix = "Z" if letter == "Y" and k >= outputs else letter
        names.append(f"{prefix}_{variable.name} = {at}")
        at += variable.size
    return [f"enum {{ {', '.join(names)} }};"] if names else []


def _values(values: Iterable[float | None]) -> str:
    # C has no empty list: what has no entries is never read
    return f"{{ {', '.join(map(repr, values)) or '0.0'} }}"


def _flags(model: Description) -> dict[str, int | float]:
    at = [sum(v.size for v in model.outputs[:k]) for k in range(len(model.outputs))]
    arrays = [(k, v.size) for k, v in zip(at, model.outputs, strict=True) if v.size > 1]
    array, size = arrays[0] if arrays else (0, 1)
    return {
        "STIFF": int(model.stiff),
        "SUBSTEP": model.substep,
        "DEFAULT_STEP": model.step,
        "MODEL_EXCHANGE": int(MODEL_EXCHANGE in model.kinds),
        "CO_SIMULATION": int(CO_SIMULATION in model.kinds),
        "HAS_EVENTS": int(model.has_events),
        "COMPLETED_STEPS": int(model.completed_steps),
        "DIRECTIONAL_DERIVATIVES": int(model.directional_derivatives),
        "SAVES_STATE": int(model.saves_state),
        "SINGLE_INSTANCE": int(model.single_instance),
        "FIXED_STEP": int(not model.variable_step),
        "FIXED_PARAMETERS": int(model.variability == "fixed"),
        "STRUCTURAL": int(model.structural is not None),
        "ARRAY_Y": array,
        "ARRAY_SIZE": size,
    } | {f"DEFECT_{name.upper()}": int(name == model.defect) for name in DEFECTS}
