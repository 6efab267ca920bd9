"""What can go wrong through the caller's hand: every error says what was given, what was expected, what to try."""

from __future__ import annotations

from typing import Any


class CtmheError(Exception):
    """Base of every error that this library raises on purpose.

    Attributes
    ----------
    run : Run or None
        What there was of a simulated run when it failed; None elsewhere.
    """

    run: Any = None


class InputError(CtmheError, ValueError):
    """A value does not fit: wrong shape, unknown name, not finite, out of its range."""


class ModelError(CtmheError, ValueError):
    """A model is inconsistent: its functions return wrong shapes, fail, or cannot be differentiated."""


class TooLate(CtmheError, ValueError):
    """A measurement or input lies before the estimation window and can no longer be used."""


class NotEstimated(CtmheError, ValueError):
    """A time was asked for that no estimate covers; `smooth` gives past times inside the last window."""


class TriggerError(CtmheError, RuntimeError):
    """A trigger policy raised or returned something that is not an answer; the policy is named."""


class SolverError(CtmheError, RuntimeError):
    """A numerical tool could not be set up (never raised for a solve that merely fails: see `Status`)."""


class CertificateError(CtmheError, ValueError):
    """No certificate: the condition cannot be met, or could not be checked; the text says what to try."""


class FmuError(CtmheError, RuntimeError):
    """An FMU cannot be read, loaded, evaluated or used in the role that it was given."""


class FmuArchiveError(FmuError):
    """The file is no readable, harmless archive, or its description no readable XML."""


class FmuVersionError(FmuError):
    """The FMI version is none of 2.0 and 3.x."""


class FmuKindError(FmuError):
    """The FMU does not offer the kind (model exchange, co-simulation) that the role needs."""


class FmuBinaryError(FmuError):
    """There is no binary for this platform, or it cannot be loaded, instantiated or initialized."""


class FmuUnsupportedError(FmuError):
    """The FMU needs what is not supported, or lacks what is needed: arrays; no states, outputs or way back in time."""


class FmuEventError(FmuError):
    """Events that an estimator was not allowed to freeze, that accumulate in a plant, or that end its simulation."""


class FmuParameterError(FmuError):
    """A parameter cannot be changed as the role needs it."""


class FmuDerivativeError(FmuError):
    """Values or derivatives are not what they should be: an estimator would go wrong without saying so."""


class MissingExtra(CtmheError, ImportError):
    """An optional library is not installed; the message names the extra that brings it."""

    def __init__(self, library: str, extra: str, purpose: str):
        super().__init__(f"{purpose} needs {library}, which is not installed: pip install 'ctmhe[{extra}]'")
        self.library, self.extra = library, extra


class FmuWarning(UserWarning):
    """Something about an FMU is wrong and was worked around; the text names it."""
