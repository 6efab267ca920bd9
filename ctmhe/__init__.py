"""ctmhe: continuous-time, event-triggered moving horizon estimation with FMU support."""

from importlib.metadata import PackageNotFoundError, version

from ctmhe.data import MeasurementLog
from ctmhe.errors import CtmheError, FmuError, InputError, MissingExtra, ModelError, NotEstimated, TooLate, TriggerError
from ctmhe.estimators import MHE, Prediction, State
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.fmu import FmuModel
from ctmhe.simulation import (
    Everything,
    FmuPlant,
    Gaussian,
    Network,
    OdePlant,
    Recorded,
    Run,
    SingleSample,
    Uniform,
    WholeSignal,
    check_fmu,
    replay,
    simulate,
)
from ctmhe.studies import Study, StudyResult, explore, find_threshold, latin_hypercube, pareto_front, sobol
from ctmhe.transcription import CVODES, RK4
from ctmhe.triggers import (
    Innovation,
    MaxInterval,
    MinInterval,
    Periodic,
    Scheduled,
    SendOnDelta,
    Trigger,
    TriggerContext,
    trigger,
)
from ctmhe.types import Bounds, DiscountedCost, Estimate, Input, Measurement, Outcome, Status, Trajectory

try:
    __version__ = version("ctmhe")
except PackageNotFoundError:  # running from a source tree that is not installed
    __version__ = "0+unknown"

__all__ = [
    "CVODES",
    "MHE",
    "RK4",
    "Bounds",
    "ContinuousModel",
    "CtmheError",
    "DiscountedCost",
    "DiscreteModel",
    "Estimate",
    "Everything",
    "FmuError",
    "FmuModel",
    "FmuPlant",
    "Gaussian",
    "Innovation",
    "Input",
    "InputError",
    "MaxInterval",
    "Measurement",
    "MeasurementLog",
    "MinInterval",
    "MissingExtra",
    "ModelError",
    "Network",
    "NotEstimated",
    "OdePlant",
    "Outcome",
    "Periodic",
    "Prediction",
    "Recorded",
    "Run",
    "Scheduled",
    "SendOnDelta",
    "SingleSample",
    "State",
    "Status",
    "Study",
    "StudyResult",
    "TooLate",
    "Trajectory",
    "Trigger",
    "TriggerContext",
    "TriggerError",
    "Uniform",
    "WholeSignal",
    "check_fmu",
    "explore",
    "find_threshold",
    "latin_hypercube",
    "pareto_front",
    "replay",
    "simulate",
    "sobol",
    "trigger",
]
