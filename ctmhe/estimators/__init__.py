"""Estimators on explicit state."""

from ctmhe.estimators.mhe import MHE, Prediction
from ctmhe.estimators.state import State

__all__ = ["MHE", "Prediction", "State"]
