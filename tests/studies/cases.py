"""Cases of studies, where workers can import them."""

from __future__ import annotations

import os
import signal

import numpy as np

from ctmhe import MHE, RK4, DiscountedCost, SingleSample, Uniform, simulate
from ctmhe.models.library import batch_reactor


def draw(*, seed, gain=1.0, policy=None):
    """A cheap case: some numbers that depend on seed and gain."""
    lots = np.random.default_rng([seed, int(1e6 * gain)])
    return {"value": gain * lots.normal(), "count": int(lots.integers(100)), "even": seed % 2 == 0, "text": f"s{seed}"}


def troubled(*, seed, kind):
    """A case that goes wrong as told, for seed 1 only."""
    if seed == 1 and kind == "raises":
        raise ValueError("as told")
    if seed == 1 and kind == "leaves":
        raise SystemExit(3)
    if seed == 1 and kind == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 1 and kind == "returns nothing":
        return None
    if seed == 1 and kind == "returns a list":
        return {"value": [1, 2]}
    if seed == 1 and kind == "takes a name":
        return {"seed": 1}
    return {"value": seed + len(kind)}


class Reactor:
    """The batch reactor, run with a policy for a second."""

    def __init__(self):
        model = batch_reactor(noise=False)
        cost = DiscountedCost(P=0.1, Q=1e3, R_point=1e4)
        self.world = batch_reactor()
        self.mhe = MHE(
            model, horizon=2.0, interval=0.1, integrator=RK4(step=0.05), cost=cost, bounds=model.bounds, hold="point"
        )

    def __call__(self, *, seed, policy):
        return simulate(
            self.world,
            self.mhe,
            trigger=policy,
            until=1.0,
            monitor=0.05,
            truth=[3.0, 1.0],
            guess=[0.1, 4.5],
            channel=SingleSample(),
            disturbance={"v_pressure": Uniform(0.02)},
            seed=seed,
        )
