"""Models: continuous, discrete, FMUs, and a library of plants."""

from ctmhe.models.continuous import ContinuousModel, Model
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.observer import observer_model
from ctmhe.models.polytope import mixture, polytope
from ctmhe.models.signals import Signals
from ctmhe.models.varying import varying_parameters

__all__ = [
    "ContinuousModel",
    "DiscreteModel",
    "Model",
    "Signals",
    "mixture",
    "observer_model",
    "polytope",
    "varying_parameters",
]
