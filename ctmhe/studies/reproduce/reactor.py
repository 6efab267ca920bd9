"""The batch reactor of thesis 3.4.1 as a case for studies: any policy, two channels, paired seeds."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from ctmhe.estimators.mhe import MHE
from ctmhe.models.library import batch_reactor
from ctmhe.simulation import OdePlant, Run, SingleSample, Uniform, WholeSignal, simulate
from ctmhe.studies.reproduce.thesis_3_4_1_ct import ETA, GUESS, HORIZON, STEP, TRUTH, UNTIL, P, Q, R
from ctmhe.transcription import RK4
from ctmhe.triggers import (
    CovarianceBound,
    Innovation,
    InnovationEnergy,
    MaxInterval,
    SendOnArea,
    SendOnDelta,
    SendOnSlope,
    Trigger,
)
from ctmhe.types import DiscountedCost

CHANNELS = {"whole signal": WholeSignal(every=STEP), "single sample": SingleSample()}
SETTLED = 1.0
"""Seconds after which the wrong guess is forgotten, whatever the policy."""

LONGEST = 0.5
"""Longest wait of the event-triggered policies in seconds."""

FAMILIES: dict[str, tuple[Callable[[float], Trigger], tuple[float, float]]] = {
    "send-on-delta": (SendOnDelta, (0.08, 0.4)),
    "send-on-slope": (SendOnSlope, (0.1, 0.6)),
    "send-on-area": (SendOnArea, (2e-3, 0.03)),
    "innovation": (Innovation, (0.06, 0.3)),
    "innovation energy": (lambda alpha: InnovationEnergy(alpha, eta=ETA, R=R), (0.05, 5.0)),
    "covariance": (CovarianceBound, (0.05, 5.0)),
}
"""Event-triggered policies by name: how they are made of a threshold, and where to look for one."""


def policy_of(family: str, threshold: float) -> Trigger:
    """Return the event-triggered policy of a family, which waits at most `LONGEST` seconds."""
    return FAMILIES[family][0](threshold) | MaxInterval(LONGEST)


def run_family(*, seed: int, threshold: float, family: str, channel: str) -> tuple[Run, dict[str, float]]:
    """Run the policy of a family with a threshold; a case for `find_threshold`."""
    return run_reactor(seed=seed, policy=policy_of(family, threshold), channel=channel)


def run_reactor(*, seed: int, policy: Trigger, channel: str = "whole signal") -> tuple[Run, dict[str, float]]:
    """Run a policy on the reactor of the thesis, |w| <= 0.1, and add the online error after the first second."""
    run = simulate(
        reactor(),
        estimator(channel),
        trigger=policy,
        until=UNTIL,
        guess=GUESS,
        truth=TRUTH,
        channel=CHANNELS[channel],
        disturbance=Uniform(0.1, interval=STEP),
        monitor=STEP,
        seed=seed,
    )
    return run, {"settled_rms": run.online_rms(since=SETTLED)}


@cache
def reactor() -> OdePlant:
    """Return the plant, once a process."""
    return OdePlant(batch_reactor())


@cache
def estimator(channel: str) -> MHE:
    """Return the estimator for a channel, once a process: weights 2P, 2Q, R of the thesis, X and W imposed.

    A single sample has the weight that the signal has over a tenth of a second, R / 10.
    """
    model = batch_reactor()
    weights: dict[str, Any] = {"R": R} if channel == "whole signal" else {"R_point": R / 10}
    return MHE(
        model,
        horizon=HORIZON,
        interval=STEP,
        integrator=RK4(STEP),
        cost=DiscountedCost(eta=ETA, P=2 * P, Q=2 * Q, **weights),
        bounds=model.bounds,
        hold="zero" if channel == "whole signal" else "point",
    )
