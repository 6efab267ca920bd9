"""When to sample: policies, how to write one, and how to join them."""

from ctmhe.triggers.base import Outlook, Predicate, Trigger, TriggerContext, trigger
from ctmhe.triggers.compose import And, MaxInterval, MinInterval, Or
from ctmhe.triggers.innovation import Innovation
from ctmhe.triggers.loading import build_trigger, load_trigger
from ctmhe.triggers.threshold import SendOnDelta
from ctmhe.triggers.timing import Periodic, Scheduled
from ctmhe.triggers.watch import Watch, WatchState

__all__ = [
    "And",
    "Innovation",
    "MaxInterval",
    "MinInterval",
    "Or",
    "Outlook",
    "Periodic",
    "Predicate",
    "Scheduled",
    "SendOnDelta",
    "Trigger",
    "TriggerContext",
    "Watch",
    "WatchState",
    "build_trigger",
    "load_trigger",
    "trigger",
]
