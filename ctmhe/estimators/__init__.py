"""Estimators on explicit state."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ctmhe.estimators.base import Estimator
from ctmhe.estimators.filters.filter import Filter
from ctmhe.estimators.filters.filter_state import FilterState
from ctmhe.estimators.filters.kalman import Extended, Kalman
from ctmhe.estimators.filters.luenberger import Luenberger
from ctmhe.estimators.filters.robust_kalman import RobustKalman, norm_bounded
from ctmhe.estimators.filters.unscented import Unscented
from ctmhe.estimators.mhe import MHE, Prediction
from ctmhe.estimators.offline.nonlinear import OfflineEstimate, estimate_offline
from ctmhe.estimators.priors.arrival import ArrivalUpdate
from ctmhe.estimators.priors.kalman_weight import KalmanWeight
from ctmhe.estimators.priors.polytopic import AdaptiveArrival, dual_iterations, polytopic_horizon
from ctmhe.estimators.priors.suboptimal import Suboptimal
from ctmhe.estimators.state import State

if TYPE_CHECKING:
    from ctmhe.estimators.priors.checked import CheckedPrior
    from ctmhe.estimators.priors.joint import ExcitedPrior

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

_LATER = {"CheckedPrior": "priors.checked", "ExcitedPrior": "priors.joint"}


def __getattr__(name: str) -> Any:
    """Return what needs parts of SciPy that other estimators do without, imported when asked for."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
