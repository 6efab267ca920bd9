"""FMUs: opened safely, described, checked, and used as models."""

from ctmhe.models.fmu.model import FmuModel, describe

__all__ = ["FmuModel", "describe"]
