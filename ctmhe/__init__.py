"""ctmhe: continuous-time, event-triggered moving horizon estimation with FMU support."""

from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from ctmhe.certificates.guarantee import Guarantee
from ctmhe.data import MeasurementLog
from ctmhe.errors import CtmheError, FmuError, InputError, MissingExtra, ModelError, NotEstimated, TooLate, TriggerError
from ctmhe.estimators import (
    MHE,
    AdaptiveArrival,
    Extended,
    Filter,
    Kalman,
    KalmanWeight,
    Luenberger,
    OfflineEstimate,
    Prediction,
    RobustKalman,
    State,
    Unscented,
    dual_iterations,
    estimate_offline,
    norm_bounded,
    polytopic_horizon,
)
from ctmhe.models import ContinuousModel, DiscreteModel, mixture, polytope
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
from ctmhe.solvers.dual import DualIterations
from ctmhe.studies import Study, StudyResult, explore, find_threshold, latin_hypercube, pareto_front, sobol
from ctmhe.transcription import CVODES, RK4, Exact
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
    "AdaptiveArrival",
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
    "DualIterations",
    "During",
    "DutyCycle",
    "Estimate",
    "Everything",
    "Exact",
    "Excitation",
    "Extended",
    "Filter",
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
    "Kalman",
    "KalmanWeight",
    "LevelCrossing",
    "LinearGaps",
    "Luenberger",
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
    "RobustKalman",
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
    "Unscented",
    "WholeSignal",
    "certify_detectability",
    "check_fmu",
    "dual_iterations",
    "estimate_offline",
    "explore",
    "find_threshold",
    "latin_hypercube",
    "mixture",
    "norm_bounded",
    "pareto_front",
    "polytope",
    "polytopic_horizon",
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
