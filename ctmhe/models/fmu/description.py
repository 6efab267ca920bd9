"""What an FMU says of itself, as values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ctmhe.models.signals import Signals

MODEL_EXCHANGE, CO_SIMULATION = "ModelExchange", "CoSimulation"


@dataclass(frozen=True)
class Variable:
    """One real scalar variable of an FMU; `start`, `minimum` and `maximum` are None where not given."""

    name: str
    reference: int
    causality: str
    variability: str
    initial: str | None
    unit: str
    nominal: float
    start: float | None
    minimum: float | None
    maximum: float | None

    @property
    def settable(self) -> bool:
        """Whether a value may be given before or during initialization."""
        if self.variability == "constant" or self.causality == "independent":
            return False
        return self.start is not None or self.causality in {"input", "parameter"} or self.initial in {"exact", "approx"}


@dataclass(frozen=True)
class Interface:
    """What an FMU offers as one kind (model exchange or co-simulation).

    `event_mode` is of FMI 3 co-simulation, `input_derivatives` (inputs that change linearly over a step) of FMI 2's.
    """

    identifier: str
    directional_derivatives: bool
    get_set_state: bool
    single_instance: bool
    completed_step: bool
    variable_step: bool
    event_mode: bool = False
    input_derivatives: bool = False


@dataclass(frozen=True)
class Description:
    """What an FMU says of itself.

    Attributes
    ----------
    version : str
        `2.0`, `3.0`, ...
    name, tool, token : str
        Model name, generating tool, and the identifier that its binary checks.
    kinds : mapping kind -> Interface
        Keys `ModelExchange`, `CoSimulation`.
    variables : mapping name -> Variable
        All real scalars (aliases included).
    states, derivatives, inputs, outputs, parameters : tuple of Variable
        `derivatives[i]` is d `states[i]` / dt. `parameters` are the tunable and the fixed ones.
    event_indicators : int
    unsupported : mapping name -> reason
        Variables that are arrays or structural parameters.
    step, tolerance : float or None
        Of the default experiment.
    """

    version: str
    name: str
    tool: str
    token: str
    kinds: Mapping[str, Interface]
    variables: Mapping[str, Variable]
    states: tuple[Variable, ...]
    derivatives: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    event_indicators: int
    unsupported: Mapping[str, str]
    step: float | None
    tolerance: float | None

    @property
    def major(self) -> int:
        """Major version of the FMI standard, 2 or 3."""
        return int(self.version.split(".")[0])

    def select(self, role: str, names: Iterable[str] | str | None, known: Sequence[Variable]) -> tuple[Variable, ...]:
        """Return the variables of `names`, all of `known` when None; an unknown name raises with the nearest."""
        if names is None:
            return tuple(known)
        wanted = (names,) if isinstance(names, str) else tuple(names)
        signals = Signals.of(role, [variable.name for variable in known])
        return tuple(known[signals.index(name)] for name in wanted)


def signals_of(kind: str, variables: Sequence[Variable], prefix: str = "", per_second: bool = False) -> Signals:
    """Return variables as `Signals`; `prefix` and `per_second` make the disturbances that belong to them."""
    names = [prefix + variable.name for variable in variables]
    suffix = "/s" if per_second else ""
    units = {name: v.unit + suffix if v.unit else "" for name, v in zip(names, variables, strict=True)}
    return Signals.of(kind, names, units, {name: v.nominal for name, v in zip(names, variables, strict=True)})
