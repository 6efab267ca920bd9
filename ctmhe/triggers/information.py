"""Policies of information: sample when the parameters are excited."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.types import finite_time

if TYPE_CHECKING:
    from ctmhe.certificates.excitation import ExcitationMonitor


class ExcitationMeasure(Protocol):
    """How much a sample at `ctx.t` would tell about the parameters: a number that is larger when it is more.

    A function of the context, or an object with `__call__`. It sees what a policy sees, and must be the same for the
    same context; one that pickles (a function of a module, a frozen dataclass) can go to worker processes.
    """

    def __call__(self, ctx: TriggerContext, /) -> float:
        """Return the excitation, in the measure's own unit; not NaN."""
        ...


@dataclass(frozen=True)
class WindowExcitation:
    """The level alpha_t (7.62) of the last estimate's window, continued to now without disturbance.

    Zero before the first estimate. In y's units squared; see `ExcitationMonitor` for what it promises.

    Parameters
    ----------
    monitor : ExcitationMonitor
        Its model has the estimator's parameters.
    """

    monitor: ExcitationMonitor

    def __post_init__(self) -> None:
        from ctmhe.certificates.excitation import ExcitationMonitor  # with parts of SciPy that no other policy needs

        if not isinstance(self.monitor, ExcitationMonitor):
            raise InputError(
                f"WindowExcitation: expected ExcitationMonitor(design_excitation(model)), got {self.monitor!r}"
            )

    def __call__(self, ctx: TriggerContext, /) -> float:
        """Return alpha_t at the time of the context."""
        if ctx.estimate is None:
            return 0.0
        return self.monitor.level(ctx.estimate.trajectory, until=ctx.t)


@dataclass(frozen=True, repr=False)
class Excitation(Trigger):
    """Sample while the parameters are excited: measure(ctx) - level >= 0.

    Estimates of parameters improve only with data that depend on them: persistent excitation, as thesis ch. 5 demands
    of the windows used for them. `WindowExcitation` measures it as thesis 7.2 does; any other measure will do.

    Parameters
    ----------
    measure : callable ctx -> float
    level : float
        Threshold, finite, in the measure's unit.
    """

    measure: ExcitationMeasure
    level: float

    def __post_init__(self) -> None:
        if not callable(self.measure):
            raise InputError(f"Excitation: measure must be a function of the context, got {self.measure!r}")
        try:
            level = finite_time(self.level, "")
        except InputError:
            raise InputError(f"Excitation: level must be a finite number, got {self.level!r}") from None
        object.__setattr__(self, "level", level)

    def guard(self, ctx: TriggerContext) -> float:
        """Return the excitation above the level."""
        return self.measure(ctx) - self.level
