"""Estimators on explicit state."""

from ctmhe.estimators.kalman_weight import KalmanWeight
from ctmhe.estimators.mhe import MHE, Prediction
from ctmhe.estimators.offline import OfflineEstimate, estimate_offline
from ctmhe.estimators.state import State

__all__ = ["MHE", "KalmanWeight", "OfflineEstimate", "Prediction", "State", "estimate_offline"]
