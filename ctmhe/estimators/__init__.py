"""Estimators on explicit state."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ctmhe.estimators.arrival import ArrivalUpdate
from ctmhe.estimators.base import Estimator
from ctmhe.estimators.filter import Filter
from ctmhe.estimators.filter_state import FilterState
from ctmhe.estimators.kalman import Extended, Kalman
from ctmhe.estimators.kalman_weight import KalmanWeight
from ctmhe.estimators.luenberger import Luenberger
from ctmhe.estimators.mhe import MHE, Prediction
from ctmhe.estimators.offline import OfflineEstimate, estimate_offline
from ctmhe.estimators.polytopic import AdaptiveArrival, dual_iterations, polytopic_horizon
from ctmhe.estimators.robust_kalman import RobustKalman, norm_bounded
from ctmhe.estimators.state import State
from ctmhe.estimators.suboptimal import Suboptimal
from ctmhe.estimators.unscented import Unscented

if TYPE_CHECKING:
    from ctmhe.estimators.checked import CheckedPrior
    from ctmhe.estimators.joint import ExcitedPrior

__all__ = [
    "MHE",
    "AdaptiveArrival",
    "ArrivalUpdate",
    "CheckedPrior",
    "Estimator",
    "ExcitedPrior",
    "Extended",
    "Filter",
    "FilterState",
    "Kalman",
    "KalmanWeight",
    "Luenberger",
    "OfflineEstimate",
    "Prediction",
    "RobustKalman",
    "State",
    "Suboptimal",
    "Unscented",
    "dual_iterations",
    "estimate_offline",
    "norm_bounded",
    "polytopic_horizon",
]

_LATER = {"CheckedPrior": "checked", "ExcitedPrior": "joint"}


def __getattr__(name: str) -> Any:
    """Return what needs parts of SciPy that other estimators do without, imported when asked for."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
