"""Time-ordered measurements and inputs, and the slice of them that one window sees."""

from ctmhe.data.log import Log, MeasurementLog

__all__ = ["Log", "MeasurementLog"]
