# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # My plant, my trigger
# A pendulum with a motor, an encoder, a gyro and unknown friction. Four sampling policies, written in the three ways
# there are, and what each costs in samples and error. Then what real sensors do: arrive late, fall silent.

# %%
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from ctmhe import (
    MHE,
    RK4,
    Bounds,
    ContinuousModel,
    CtmheError,
    DiscountedCost,
    Gaussian,
    Input,
    MaxInterval,
    Measurement,
    MinInterval,
    OdePlant,
    Periodic,
    SingleSample,
    TooLate,
    Trigger,
    simulate,
    trigger,
)

plt.rcParams.update({"figure.dpi": 80, "axes.grid": True, "grid.color": "#dddddd"})

# %% [markdown]
# ## The plant
# Functions of (t, x, u, w, p) on CasADi symbols. The estimator's model has no noise in w: the output residual is the
# noise. The simulated plant needs noise to add, so the same function makes it too. The model checks itself when it is
# built.

# %%
UNITS = {
    "angle": "rad",
    "speed": "rad/s",
    "torque": "N m",
    "shake": "rad/s2",
    "friction": "1/s",
    "encoder": "rad",
    "gyro": "rad/s",
}
NOISE = {"v_encoder": 0.02, "v_gyro": 0.2}
PUSH, CELL = 1.0, 0.1  # rad/s2, s: unknown torque, redrawn every cell


def pendulum(noise):
    def f(t, x, u, w, p):
        angle, speed = x[0], x[1]
        return speed, -9.81 / 0.5 * ca.sin(angle) - p[0] * speed + 4.0 * u[0] + w[0]

    def h(t, x, u, w, p):
        return x[0] + (w[1] if noise else 0), x[1] + (w[2] if noise else 0)

    return ContinuousModel(
        f,
        h,
        x=("angle", "speed"),
        u="torque",
        w=("shake", *NOISE) if noise else "shake",
        p="friction",
        y=("encoder", "gyro"),
        units=UNITS,
        p_start=[0.1],
        name="pendulum",
    )


model = pendulum(noise=False)
print(model)
try:
    ContinuousModel(lambda t, x, u, w, p: math.sin(x[0]), lambda t, x, u, w, p: x[0], x="angle", y="encoder")
except CtmheError as error:
    print(f"\nmath instead of casadi: {error}")

# %% [markdown]
# P names states *and* a parameter, so the friction is estimated along. All weights are inverse covariances.

# %%
mhe = MHE(
    model,
    horizon=1.5,
    interval=CELL,
    integrator=RK4(step=0.05),
    cost=DiscountedCost(
        P={"angle": 1 / 0.5**2, "speed": 1 / 1.0**2, "friction": 1 / 0.1**2},
        Q=1 / (PUSH**2 * CELL),
        R_point={"encoder": 1 / NOISE["v_encoder"] ** 2, "gyro": 1 / NOISE["v_gyro"] ** 2},
    ),
    bounds=Bounds(p={"friction": (0.0, 2.0)}),
    hold="point",
)


# %% [markdown]
# ## Four policies
# A policy answers one question, in one of three ways. It sees what was measured and sent so far, and the estimate; it
# does not see the truth or the estimator's insides. What it has to remember lives in `ctx.state`, so that one policy
# can serve many runs.


# %%
@trigger  # 1: a predicate, asked at monitoring times
def drifted(ctx):
    return bool(abs(ctx.y - ctx.y_hat)[0] > 0.08)


@dataclass(frozen=True, repr=False)
class Beam(Trigger):  # 2: a guard, whose zero is located between monitoring times
    """A light barrier at the bottom: sample when the pendulum passes, in either direction."""

    width: float = 0.15  # rad: armed again when this far away

    def guard(self, ctx):
        if not ctx.samples:
            return np.inf  # a certain yes: start with a sample
        return -ctx.state * ctx.y[ctx.output_index("encoder")] if ctx.state else -np.inf

    def init_state(self):
        return 0  # the side on which it is armed; 0: not armed

    def update(self, ctx, fired):
        angle = ctx.y[ctx.output_index("encoder")]
        if fired:
            return 0
        return int(np.sign(angle)) if abs(angle) > self.width else ctx.state


@dataclass(frozen=True, repr=False)
class FastLooksOften(Trigger):  # 3: self-triggered, says when to look again
    """Next sample after `travel` radians at the estimated speed."""

    travel: float = 0.5

    def next_time(self, ctx):
        if ctx.estimate is None:
            return ctx.t
        return ctx.t + float(np.clip(self.travel / abs(ctx.estimate.x[1]), 0.04, 0.5))


policies = {
    "predicate": drifted | MaxInterval(0.5),
    "guard": Beam() | MaxInterval(0.5),
    "self-triggered": FastLooksOften(),
    "composed": (drifted & MinInterval(0.1)) | Beam() | MaxInterval(0.5),
}
policies |= {f"every {period:g} s": Periodic(period) for period in (0.06, 0.12, 0.25, 0.5)}
for name, policy in policies.items():
    print(f"{name:15} {policy}")

# %% [markdown]
# ## What they cost
# The seed fixes disturbance and noise, whatever the policy: eight policies face the same five worlds.

# %%
plant = OdePlant(pendulum(noise=True))
disturbance = {"shake": Gaussian(PUSH, interval=CELL)} | {
    name: Gaussian(std, interval=0.01) for name, std in NOISE.items()
}


def run_with(policy, seed):
    return simulate(
        plant,
        mhe,
        trigger=policy,
        until=6.0,
        guess={"angle": 2.0, "speed": 0.0},
        truth={"angle": 2.5, "speed": 0.0},
        p_true=[0.5],
        channel=SingleSample(),
        disturbance=disturbance,
        inputs=lambda t: 0.4 if t % 2.0 < 1.0 else -0.4,
        monitor=0.02,
        seed=seed,
    )


rows, kept = [], {}
for name, policy in policies.items():
    for seed in range(5):
        run = kept[name] = run_with(policy, seed)
        friction = float(run.dataset["p_hat"].isel(solve=-1).item())
        rows.append(
            {
                "policy": name,
                "samples": run.samples,
                "angle rms": run.online_rms("angle"),
                "speed rms": run.online_rms("speed"),
                "friction error": abs(friction - 0.5),
            }
        )
table = pd.DataFrame(rows)
mean = table.groupby("policy", sort=False).mean().round(3)
mean

# %%
figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
clock = mean[mean.index.str.startswith("every")]
axis.plot(clock["samples"], clock["angle rms"], color="#999999", marker="o", ms=4, label="clock, four rates")
marks = zip(
    ("predicate", "guard", "self-triggered", "composed"),
    "s^Dv",
    ("#D55E00", "#009E73", "#0072B2", "#CC79A7"),
    strict=True,
)
for name, marker, color in marks:
    group = table[table["policy"] == name]
    axis.plot(group["samples"], group["angle rms"], color=color, marker=marker, ms=4, ls="none", alpha=0.35)
    axis.plot(*mean.loc[name, ["samples", "angle rms"]], color=color, marker=marker, ms=9, ls="none", label=name)
axis.set(xlabel="samples in 6 s", ylabel="online RMS error of the angle [rad]")
axis.set_ylim(bottom=0)
axis.legend(frameon=False)
plt.show()

# %% [markdown]
# - The **predicate** compares with the model's prediction: half the samples of a clock of equal error. Its price: the
#   sensor must know the prediction.
# - **Passing the bottom** and **looking often when fast** sound clever and are no better than a clock: they sample
#   where the pendulum moves, not where the estimate is wrong.
# - Friction (true: 0.5) is found to 0.04 to 0.08 by all of them, and most samples do not mean the best value: the
#   parameter needs the length of the record, not the rate.
#
# One seed, side by side:

# %%
figure, axis = plt.subplots(figsize=(9, 3), layout="constrained")
run = kept["composed"]
axis.plot(run.t, run.dataset["x_true"].sel(state="angle"), color="black", lw=1.2)
axis.set(ylabel="angle [rad]", xlabel="time [s]", xlim=(-0.05, 6), ylim=(-5.2, 2.8), yticks=[-2, 0, 2])
for row, (name, color) in enumerate(
    zip(("predicate", "guard", "self-triggered", "composed"), ("#D55E00", "#009E73", "#0072B2", "#CC79A7"), strict=True)
):
    times = kept[name].sample_times
    axis.vlines(times, -3.05 - 0.55 * row, -2.65 - 0.55 * row, color=color, lw=1.5)
    axis.annotate(name, (6.05, -3.0 - 0.55 * row), color=color, annotation_clip=False, fontsize=9)
plt.show()

# %% [markdown]
# ## Late and partial measurements
# The gyro is on time; the encoder's packets are stuck for 0.4 s and then arrive in reverse order. `observe` takes any
# order; a sensor left out of a mapping (or NaN) says nothing. Everything that changes is in `state`, so branching
# costs nothing.

# %%
run = kept["every 0.06 s"]
events = run.events_to_pandas().query("sample_time < 1.3")
start = mhe.init(t=0.0, x={"angle": 2.0, "speed": 0.0})
for t, torque in ((0.0, 0.4), (1.0, -0.4)):
    start = mhe.control(start, Input(t, {"torque": torque}))


def told(state, sensor, chosen):
    for t, y in zip(chosen["sample_time"], chosen[f"y_sampled.{sensor}"], strict=True):
        state = mhe.observe(state, Measurement(t, {sensor: y}))
    return state


now = float(events["sample_time"].iloc[-1])
true = run.dataset["x_true"].sel(time=now, method="nearest").to_numpy()
late = events["sample_time"] > now - 0.4

waiting = told(told(start, "gyro", events), "encoder", events[~late])
waiting, early = mhe.estimate(waiting, now)
_, complete = mhe.estimate(told(waiting, "encoder", events[late][::-1]), now)  # the same instant, once more
_, in_order = mhe.estimate(told(told(start, "encoder", events), "gyro", events), now)
for label, estimate in (("encoder missing", early), ("late, reversed", complete), ("all on time", in_order)):
    std = np.sqrt(np.diag(estimate.covariance))[:2].round(3)
    print(f"{label:16} error {(estimate.x - true).round(4)}  std {std}")
print(f"late and on time differ by {np.abs(complete.x - in_order.x).max():.0e}")

# %%
state, _ = mhe.estimate(waiting, 2.5)  # the window is now [1, 2.5] s
try:
    mhe.observe(state, Measurement(0.5, {"encoder": 1.0}))
except TooLate as error:
    print(error)
try:
    mhe.observe(state, Measurement(2.6, {"encodr": 1.0}))
except CtmheError as error:
    print(error)

# %% [markdown]
# ## Stop and go on
# A state is saved without pickle and loaded by an estimator of the same configuration; going on equals never having
# stopped.

# %%
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "state.npz"
    mhe.save(state, file)
    print(f"{file.stat().st_size / 1000:.0f} kB")
    loaded = mhe.load(file)
more = Measurement(2.7, {"encoder": 0.3})
here, there = (mhe.estimate(mhe.observe(s, more), 2.7)[1] for s in (state, loaded))
print("same to the last bit:", bool((here.x == there.x).all()))
