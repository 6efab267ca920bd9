"""What an FMU says of itself, as values."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ctmhe.models.fmu.selection import select
from ctmhe.models.fmu.units import Unit
from ctmhe.models.signals import Signals

MODEL_EXCHANGE, CO_SIMULATION = "ModelExchange", "CoSimulation"
SYSTEMS = {"win32": "win", "cygwin": "win", "darwin": "darwin"}
ARCHITECTURES = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64", "i686": "x86"}
LIBRARY_SUFFIXES = {"win": ".dll", "darwin": ".dylib"}


@dataclass(frozen=True)
class Variable:
    """One real scalar variable of an FMU; `start`, `minimum` and `maximum` are None where not given.

    `unit` and `description` are empty where not given; `nominal` is then 1, as it is where zero or not finite.
    """

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
    description: str = ""

    @property
    def settable(self) -> bool:
        """Whether a value may be given before or during initialization."""
        if self.variability == "constant" or self.causality == "independent":
            return False
        return self.start is not None or self.causality in {"input", "parameter"} or self.initial in {"exact", "approx"}


@dataclass(frozen=True)
class Interface:
    """What an FMU offers as one kind (model exchange or co-simulation).

    `event_mode`, `early_return` and `fixed_step` (seconds, None where not stated) are of FMI 3 co-simulation;
    `input_derivatives` (inputs that change linearly over a step) is of FMI 2 co-simulation; `needs_tool` says that
    the binary only calls the tool that made it.
    """

    identifier: str
    directional_derivatives: bool
    get_set_state: bool
    single_instance: bool
    completed_step: bool
    variable_step: bool
    needs_tool: bool = False
    event_mode: bool = False
    early_return: bool = False
    fixed_step: float | None = None
    input_derivatives: bool = False


@dataclass(frozen=True)
class Sources:
    """Files that are compiled together into a binary; paths are relative to the FMU's folder `sources`.

    `defines` are (macro, value) or (macro, "") for those without a value; `language` is as written, such as `C99`.
    """

    files: tuple[str, ...]
    language: str = ""
    defines: tuple[tuple[str, str], ...] = ()
    includes: tuple[str, ...] = ()


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
        `derivatives[i]` is d `states[i]` / dt. `parameters` are the tunable and the fixed ones. Alias names of FMI 3
        are in `variables` only.
    event_indicators : int
    unsupported : mapping name -> reason
        Structural parameters, and arrays that are input, output, parameter, state, derivative or event indicator.
    step, tolerance, start_time, stop_time : float or None
        Of the default experiment; times in seconds.
    dependencies : mapping name -> tuple of names, or None
        What each derivative and output says it depends on; None where it does not say.
    units : mapping name -> Unit
        Those whose SI base units are given.
    platforms : tuple of str
        Folders in `binaries`.
    sources : mapping kind -> tuple of Sources
        Empty for an FMU without C files.
    description : str
    complaints : tuple of str
        Those of its log categories that the standard keeps for warnings and errors.
    remarks : tuple of str
        What in it is of no use, and what is taken instead.
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
    start_time: float | None = None
    stop_time: float | None = None
    dependencies: Mapping[str, tuple[str, ...] | None] = field(default_factory=dict)
    units: Mapping[str, Unit] = field(default_factory=dict)
    platforms: tuple[str, ...] = ()
    sources: Mapping[str, tuple[Sources, ...]] = field(default_factory=dict)
    description: str = ""
    complaints: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def major(self) -> int:
        """Major version of the FMI standard, 2 or 3."""
        return int(self.version.split(".")[0])

    def select(self, role: str, wanted: Iterable[str] | str | None, known: Sequence[Variable]) -> tuple[Variable, ...]:
        """Return those of `known` that `wanted` says, each once.

        Parameters
        ----------
        role : str
            What they are, for messages: `input`, `state`, ...
        wanted : str, iterable of str, or None
            Names; patterns with `*` and `?` (`zone*.T`; brackets are part of a name); `causality:output`,
            `variability:tunable` and their like. None means all. A name that is there wins over a pattern.
        known : sequence of Variable

        Returns
        -------
        tuple of Variable
            In the order of `wanted`, within a pattern in that of `known`.

        Raises
        ------
        InputError
            Nothing fits one of `wanted`; with the nearest names.
        """
        return select(role, wanted, known)


def platform_folder(major: int) -> str:
    """Return the folder of this platform's binaries: `linux64` and its like for FMI 2, `x86_64-linux` for FMI 3."""
    system = SYSTEMS.get(sys.platform, "linux")
    if major == 2:
        return system + ("64" if sys.maxsize > 2**32 else "32")
    machine = platform.machine().lower()
    return f"{ARCHITECTURES.get(machine, machine)}-{'windows' if system == 'win' else system}"


def library_suffix() -> str:
    """Return how the file name of a binary ends here."""
    return LIBRARY_SUFFIXES.get(SYSTEMS.get(sys.platform, ""), ".so")


def signals_of(kind: str, variables: Sequence[Variable], prefix: str = "", per_second: bool = False) -> Signals:
    """Return variables as `Signals`; `prefix` and `per_second` make the disturbances that belong to them."""
    names = [prefix + variable.name for variable in variables]
    suffix = "/s" if per_second else ""
    units = {name: v.unit + suffix if v.unit else "" for name, v in zip(names, variables, strict=True)}
    return Signals.of(kind, names, units, {name: v.nominal for name, v in zip(names, variables, strict=True)})
