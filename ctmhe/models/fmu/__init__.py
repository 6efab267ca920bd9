"""FMUs: opened safely, described, checked, and used as models."""

from ctmhe.models.fmu.model import FmuModel
from ctmhe.models.fmu.report import describe

__all__ = ["FmuModel", "describe"]
