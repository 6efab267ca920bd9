"""From a model and a cost to the arrays of one window's problem; the stage function is the only compiled thing."""

from ctmhe.transcription.integrators import CVODES, RK4, Exact

__all__ = ["CVODES", "RK4", "Exact"]
