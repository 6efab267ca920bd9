"""ctmhe: continuous-time, event-triggered moving horizon estimation with FMU support."""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from ctmhe.certificates.guarantee import Guarantee
from ctmhe.data import MeasurementLog
from ctmhe.errors import CtmheError, FmuError, InputError, MissingExtra, ModelError, NotEstimated, TooLate, TriggerError
from ctmhe.estimators import MHE, KalmanWeight, OfflineEstimate, Prediction, State, estimate_offline
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
    BoundSelfTriggered,
    Budget,
    Certified,
    CovarianceBound,
    CovarianceSelfTriggered,
    Deadband,
    During,
    DutyCycle,
    Excitation,
    GeometricGaps,
    Hysteresis,
    Innovation,
    InnovationEnergy,
    Jittered,
    LevelCrossing,
    LinearGaps,
    MaxInterval,
    MinInterval,
    Periodic,
    Phases,
    Poisson,
    Scheduled,
    SendOnArea,
    SendOnDelta,
    SendOnSlope,
    Stochastic,
    TokenBucket,
    Trigger,
    TriggerContext,
    trigger,
)
from ctmhe.types import Bounds, DiscountedCost, Estimate, Input, Measurement, Outcome, Status, Trajectory

if TYPE_CHECKING:
    from ctmhe.certificates import DetectabilityCertificate, certify_detectability

try:
    __version__ = version("ctmhe")
except PackageNotFoundError:  # running from a source tree that is not installed
    __version__ = "0+unknown"

__all__ = [
    "CVODES",
    "MHE",
    "RK4",
    "BoundSelfTriggered",
    "Bounds",
    "Budget",
    "Certified",
    "ContinuousModel",
    "CovarianceBound",
    "CovarianceSelfTriggered",
    "CtmheError",
    "Deadband",
    "DetectabilityCertificate",
    "DiscountedCost",
    "DiscreteModel",
    "During",
    "DutyCycle",
    "Estimate",
    "Everything",
    "Excitation",
    "FmuError",
    "FmuModel",
    "FmuPlant",
    "Gaussian",
    "GeometricGaps",
    "Guarantee",
    "Hysteresis",
    "Innovation",
    "InnovationEnergy",
    "Input",
    "InputError",
    "Jittered",
    "KalmanWeight",
    "LevelCrossing",
    "LinearGaps",
    "MaxInterval",
    "Measurement",
    "MeasurementLog",
    "MinInterval",
    "MissingExtra",
    "ModelError",
    "Network",
    "NotEstimated",
    "OdePlant",
    "OfflineEstimate",
    "Outcome",
    "Periodic",
    "Phases",
    "Poisson",
    "Prediction",
    "Recorded",
    "Run",
    "Scheduled",
    "SendOnArea",
    "SendOnDelta",
    "SendOnSlope",
    "SingleSample",
    "State",
    "Status",
    "Stochastic",
    "Study",
    "StudyResult",
    "TokenBucket",
    "TooLate",
    "Trajectory",
    "Trigger",
    "TriggerContext",
    "TriggerError",
    "Uniform",
    "WholeSignal",
    "certify_detectability",
    "check_fmu",
    "estimate_offline",
    "explore",
    "find_threshold",
    "latin_hypercube",
    "pareto_front",
    "replay",
    "simulate",
    "sobol",
    "trigger",
]


def __getattr__(name: str) -> Any:
    """Return what few programs need, imported when asked for."""
    if name not in ("DetectabilityCertificate", "certify_detectability"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ctmhe import certificates

    return getattr(certificates, name)
