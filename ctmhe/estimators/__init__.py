"""Estimators on explicit state."""

from ctmhe.estimators.arrival import ArrivalUpdate
from ctmhe.estimators.mhe import MHE, Prediction
from ctmhe.estimators.state import State
from ctmhe.estimators.suboptimal import Suboptimal

__all__ = ["MHE", "ArrivalUpdate", "Prediction", "State", "Suboptimal"]
