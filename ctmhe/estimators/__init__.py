"""Estimators on explicit state."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ctmhe.estimators.mhe import MHE, Prediction
from ctmhe.estimators.state import State

if TYPE_CHECKING:
    from ctmhe.estimators.checked import CheckedPrior
    from ctmhe.estimators.joint import ExcitedPrior

__all__ = ["MHE", "CheckedPrior", "ExcitedPrior", "Prediction", "State"]

_LATER = {"CheckedPrior": "checked", "ExcitedPrior": "joint"}


def __getattr__(name: str) -> Any:
    """Return what needs parts of SciPy that other estimators do without, imported when asked for."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
