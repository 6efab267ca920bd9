"""What a model is to an FMU: its variables with their units, and what the FMU offers."""

from __future__ import annotations

from dataclasses import dataclass

MODEL_EXCHANGE, CO_SIMULATION = "ModelExchange", "CoSimulation"


@dataclass(frozen=True)
class Variable:
    """One variable of a model.

    Attributes
    ----------
    name, unit, description : str
    start : float or None
        Start value in `unit`; None for an output, which is calculated.
    nominal : float
        Typical magnitude in `unit`.
    depends : tuple of str
        Of a state: what its derivative depends on; of an output or event indicator: what it depends on. Names
        of states, inputs and parameters; exactly these entries of the Jacobian may differ from zero.
    rate : float or None
        Typical magnitude of a state's derivative in `unit` per second; `nominal` when None.
    reinit : bool
        Whether an event may change this state.
    size : int
        Number of entries; more than one makes an array (FMI 3, the last output only).
    """

    name: str
    unit: str
    start: float | None
    nominal: float
    description: str
    depends: tuple[str, ...] = ()
    rate: float | None = None
    reinit: bool = False
    size: int = 1


@dataclass(frozen=True)
class Description:
    """A model x' = f(x, u, p, q), y = h(x, u, p, q), written in C in `src/<source>.c`, and what its FMU offers.

    Attributes
    ----------
    name, description : str
    states, inputs, parameters, outputs : tuple of Variable
        x, u, p, y.
    stop, step : float
        Of the default experiment, in seconds; `step` is the only one when `variable_step` is False.
    stiff : bool
        The integrator of co-simulation: an L-stable Rosenbrock method with error control, or RK4.
    substep : float
        Longest step of RK4 in seconds.
    source : str
        Name of the C file; the model's when empty.
    indicators : tuple of Variable
        Event indicators z(x, u, p, q): an event is where one of them changes its sign.
    discretes : tuple of Variable
        q: what changes at events only.
    time_events : bool
        Whether events are planned ahead.
    structural : Variable or None
        A structural parameter, a whole number (FMI 3); C sees it as the entry of q after `discretes`.
    trap : str
        Empty for a plant. Else one sentence: what is unusual or wrong here.
    defect : str
        What the binary does that the model description does not tell; one of `DEFECTS`.
    versions : tuple of int
        Versions of FMI in which it can be built.
    kinds : tuple of str
        `ModelExchange`, `CoSimulation` or both.
    variability : str
        Of the parameters: `tunable`, or `fixed`, which can be set before the end of the initialization only.
    dependencies, directional_derivatives, saves_state, variable_step : bool
        What is offered: declared dependencies, derivatives, get and set of the FMU state, communication steps of
        any length.
    single_instance, completed_steps : bool
        What is demanded: one instance in a process, a word after each integration step.
    """

    name: str
    description: str
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    stop: float
    step: float
    stiff: bool = False
    substep: float = 1e-3
    source: str = ""
    indicators: tuple[Variable, ...] = ()
    discretes: tuple[Variable, ...] = ()
    time_events: bool = False
    structural: Variable | None = None
    trap: str = ""
    defect: str = ""
    versions: tuple[int, ...] = (2, 3)
    kinds: tuple[str, ...] = (MODEL_EXCHANGE, CO_SIMULATION)
    variability: str = "tunable"
    dependencies: bool = True
    directional_derivatives: bool = True
    saves_state: bool = True
    variable_step: bool = True
    single_instance: bool = False
    completed_steps: bool = False

    @property
    def has_events(self) -> bool:
        """Whether anything can happen at an event."""
        return bool(self.indicators) or self.time_events or self.completed_steps


DEFECTS = ("crashes_at_load", "fails", "stale", "strict_parameters", "wrong_derivatives")
"""What `Description.defect` may be: `src/*.c` see the macro DEFECT_<NAME>."""

# unit -> exponents of SI base units and factor
UNITS: dict[str, dict[str, float]] = {
    "1": {},
    "1/s": {"s": -1},
    "1/s2": {"s": -2},
    "s": {"s": 1},
    "bar": {"kg": 1, "m": -1, "s": -2, "factor": 1e5},
    "bar/s": {"kg": 1, "m": -1, "s": -3, "factor": 1e5},
    "1/(bar.s)": {"kg": -1, "m": 1, "s": 1, "factor": 1e-5},
    "m": {"m": 1},
    "m2": {"m": 2},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "rad/s2": {"rad": 1, "s": -2},
    "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2},
    "kg.m/s": {"kg": 1, "m": 1, "s": -1},
    "N.s2": {"kg": 1, "m": 1},
    "N.m.s": {"kg": 1, "m": 2, "s": -1},
    "N.m.s2": {"kg": 1, "m": 2},
    "K": {"K": 1},
    "K/s": {"K": 1, "s": -1},
    "W": {"kg": 1, "m": 2, "s": -3},
    "W/m2": {"kg": 1, "s": -3},
    "K/W": {"K": 1, "kg": -1, "m": -2, "s": 3},
    "J/K": {"kg": 1, "m": 2, "s": -2, "K": -1},
}

RATE = {"1": "1/s", "bar": "bar/s", "m": "m/s", "rad": "rad/s", "m/s": "m/s2", "rad/s": "rad/s2", "K": "K/s"}
"""The unit of the derivative of a state in a given unit."""
