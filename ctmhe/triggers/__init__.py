"""When to sample: policies, how to write one, and how to join them."""

from ctmhe.triggers.base import Outlook, Predicate, Trigger, TriggerContext, trigger
from ctmhe.triggers.budget import Budget, DutyCycle, TokenBucket
from ctmhe.triggers.certified import BoundSelfTriggered, Certified
from ctmhe.triggers.compose import And, Hysteresis, MaxInterval, MinInterval, Or
from ctmhe.triggers.covariance import CovarianceBound, CovarianceSelfTriggered
from ctmhe.triggers.crossing import LevelCrossing
from ctmhe.triggers.energy import InnovationEnergy
from ctmhe.triggers.gaps import GeometricGaps, Jittered, LinearGaps, Poisson
from ctmhe.triggers.information import Excitation, ExcitationMeasure, WindowExcitation
from ctmhe.triggers.innovation import Innovation, Stochastic
from ctmhe.triggers.loading import build_trigger, load_trigger
from ctmhe.triggers.phases import During, Phases
from ctmhe.triggers.threshold import Deadband, SendOnArea, SendOnDelta, SendOnSlope
from ctmhe.triggers.timing import Periodic, Scheduled
from ctmhe.triggers.watch import Watch, WatchState

__all__ = [
    "And",
    "BoundSelfTriggered",
    "Budget",
    "Certified",
    "CovarianceBound",
    "CovarianceSelfTriggered",
    "Deadband",
    "During",
    "DutyCycle",
    "Excitation",
    "ExcitationMeasure",
    "GeometricGaps",
    "Hysteresis",
    "Innovation",
    "InnovationEnergy",
    "Jittered",
    "LevelCrossing",
    "LinearGaps",
    "MaxInterval",
    "MinInterval",
    "Or",
    "Outlook",
    "Periodic",
    "Phases",
    "Poisson",
    "Predicate",
    "Scheduled",
    "SendOnArea",
    "SendOnDelta",
    "SendOnSlope",
    "Stochastic",
    "TokenBucket",
    "Trigger",
    "TriggerContext",
    "Watch",
    "WatchState",
    "WindowExcitation",
    "build_trigger",
    "load_trigger",
    "trigger",
]
