"""FMUs as plants, and what an FMU is good for."""

from ctmhe.simulation.fmu.check import Checkup, check_fmu
from ctmhe.simulation.fmu.plant import FmuPlant

__all__ = ["Checkup", "FmuPlant", "check_fmu"]
