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
# # A quadrotor over a lossy channel
# Twelve states, six of them measured, and a radio that loses messages, delays them, rounds values and has its own
# clock. An event-triggered sensor says little, and each message matters: what does a lost one cost, and is a clock,
# which says the same over and over, better off?
#
# `CTMHE_SIZE=large` runs more seeds and a finer grid.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from ctmhe import (
    MHE,
    RK4,
    DiscountedCost,
    Gaussian,
    Innovation,
    MaxInterval,
    MinInterval,
    Network,
    OdePlant,
    Periodic,
    SingleSample,
    Study,
    simulate,
)
from ctmhe.models.library import quadrotor
from ctmhe.models.library.quadrotor import ARM, INERTIA, OUTPUTS, THRUST, hover_speed
from ctmhe.plotting import plot_error_against_samples, plot_heatmap, plot_level, plot_output, plot_state

LARGE = os.environ.get("CTMHE_SIZE") == "large"
SEEDS, WORKERS = (40, os.cpu_count()) if LARGE else (4, 1)

# %% [markdown]
# ## Plant and estimator
# The rotors sway the machine about its roll axis: an open-loop torque that turns it 0.15 rad to and fro. Gusts push and
# twist it; nobody flies it, so it drifts. The estimator's model has no noise in w: the output residual is the noise.

# %%
CELL, UNTIL = 0.05, 2.5
SWAY, PACE = 0.15, 2 * np.pi / 1.5  # rad, rad/s
NOISE = {name: 0.02 if name.startswith("z") else 0.01 for name in OUTPUTS}  # m, rad
GUSTS = {f"w_{name}": 0.8 if name.startswith("s") else 0.15 for name in ("s1", "s2", "s3", "O1", "O2", "O3")}
# m/s2, rad/s2


def rotors(t):
    """Rotor speeds [rad/s] at hover, with the torque -I SWAY PACE^2 sin(PACE t) about the roll axis."""
    share = -INERTIA[0] * SWAY * PACE**2 * np.sin(PACE * t) / (2 * ARM * THRUST)
    square = hover_speed() ** 2
    return np.sqrt([square, square - share, square, square + share])


plant = OdePlant(quadrotor(noise=True), rtol=1e-8, atol=1e-10)
model = quadrotor(noise=False)
small = {name: 1 / (0.01**2 * CELL) for name in model.w.names}
mhe = MHE(
    model,
    horizon=1.0,
    interval=CELL,
    integrator=RK4(CELL),
    cost=DiscountedCost(
        P=dict.fromkeys(model.x.names, 1 / 0.3**2),
        Q=small | {name: 1 / (std**2 * CELL) for name, std in GUSTS.items()},
        R_point={name: 1 / std**2 for name, std in NOISE.items()},
    ),
    hold="point",
)
truth = np.zeros(12)
truth[9] = SWAY * PACE  # the roll rate that the sway begins with
gusts = {name: Gaussian(std, interval=CELL) for name, std in GUSTS.items()}
noise = {f"v_{name}": Gaussian(std, interval=0.01) for name, std in NOISE.items()}


def fly(*, seed, policy, **network):
    return simulate(
        plant,
        mhe,
        trigger=policy,
        until=UNTIL,
        guess=np.zeros(12),
        truth=truth,
        channel=Network(SingleSample(), value_bytes=2, **network) if network else SingleSample(),
        disturbance=gusts | noise,
        inputs=rotors,
        monitor=0.02,
        seed=seed,
    )


def position_rms(run):
    return run.online_rms(["z1", "z2", "z3"])  # m


# %% [markdown]
# ## What the trigger knows
# The innovation is counted in its standard deviations, so metres and radians go together. The trigger lives at the
# sensor. On a faithful channel what was sent is what is known, and sensor and estimator agree on the prediction. Over a
# `Network` they need not: the sensor runs a copy of the estimator that knows what was *sent* (`run.sensor_solves` says
# what that costs), and its prediction may be better than that of the estimator it wants to help. It cannot know that a
# message was lost.

# %%
sizes = {name: (3.0 * std) ** 2 for name, std in NOISE.items()}  # prediction error and noise
event = (Innovation(1.3, covariance=np.array(list(sizes.values()))) & MinInterval(0.04)) | MaxInterval(0.5)
runs = {
    "faithful": fly(seed=1, policy=event),
    "a third lost": fly(seed=1, policy=event, loss=1 / 3),
    "late by up to 0.1 s": fly(seed=1, policy=event, delay=(0.02, 0.1)),
    "centimetres, hundredths": fly(seed=1, policy=event, quantum=0.01),
    "clock 20 ms ahead": fly(seed=1, policy=event, clock_offset=0.02),
}
print(f"{'':24} samples  lost  bytes  solves  at the sensor  too late  position [m]")
for name, run in runs.items():
    print(
        f"{name:24} {run.samples:7} {run.messages_lost:5} {run.bytes_sent:6} {run.solves:7} {run.sensor_solves:14} "
        f"{run.too_late:9}  {position_rms(run):.4f}"
    )
lossy = runs["a third lost"]
assert lossy.solves == lossy.messages - lossy.messages_lost
assert position_rms(runs["faithful"]) < position_rms(lossy)

# %% [markdown]
# Every sample of a lossy run is drawn, also those that never arrived: the estimate jumps only where one did.

# %%
figure, panels = plt.subplots(3, 1, figsize=(8, 6), sharex=True, layout="constrained")
plot_state(lossy.dataset, "phi", panels[0])
panels[0].legend(loc="upper right", ncols=2, fontsize=8)
plot_output(lossy.dataset, "z1", panels[1])
plot_level(lossy.dataset, panels[2])
panels[2].set(xlabel="time [s]", ylabel="level [std]")
plt.show()

# %% [markdown]
# ## Loss, and three ways to sample
# As many messages as the event-triggered sensor needs without loss, sent by a clock; and a clock of twice the rate,
# which spends redundancy on the loss.

# %%
messages = int(np.mean([fly(seed=seed, policy=event).messages for seed in range(SEEDS)]))
policies = {
    "event": event,
    "clock": Periodic(UNTIL / messages),
    "clock, twice": Periodic(UNTIL / messages / 2),
}
losses = (0.0, 0.1, 0.2, 0.3, 0.5) if LARGE else (0.0, 0.4)


def lossy_flight(*, seed, policy, loss):
    run = fly(seed=seed, policy=policy, loss=loss)
    return run, {"position_rms": position_rms(run)}


study = Study(lossy_flight, {"policy": policies, "loss": losses}, SEEDS)
result = study.run(workers=WORKERS)
table = result.means("messages", "messages_lost", "position_rms", "online_rms.phi")
table.round(3)

# %%
axes = plot_error_against_samples(result.table, error="position_rms", samples="loss", by="policy", parameter="loss")
axes.set(xlabel="share of lost messages", ylabel="online RMS error of the position [m]")
plt.show()

# %%
result.compare("position_rms", {"policy": "clock"}).drop(columns=["dropped", "better"]).round(4)  # the same loss

# %% [markdown]
# Nobody sends more because messages are lost: the clock never does, and the event's sensor does not notice, since its
# copy of the estimator knows what was sent. So the event's advantage over a clock with as many messages shrinks with
# the loss: the messages that matter most are lost as often as any. Twice as many of them is what helps against loss.
#
# ## Loss and delay
# The estimator takes late measurements at their own times, so a delay is a delay of knowledge, not an error.

# %%
delays = (0.0, 0.05, 0.1, 0.2) if LARGE else (0.0, 0.1)


def late_flight(*, seed, loss, delay):
    run = fly(seed=seed, policy=event, loss=loss, delay=delay)
    return run, {"position_rms": position_rms(run)}


both = Study(late_flight, {"loss": losses, "delay": delays}, SEEDS // 2).run(workers=WORKERS)
plot_heatmap(both.table, x="loss", y="delay", value="position_rms")
plt.show()

# %% [markdown]
# ## A dead link
# Losses that come in outages of 0.6 s on average. Without messages the estimator goes on in open loop and the error
# grows; the first message that gets through ends it. A silence longer than the horizon leaves nothing measured in the
# window's past: the prior is then the prediction, with its weight relaxed, and the status of that solve says so.

# %%
dead = fly(seed=3, policy=event, loss=0.4, outage=0.6)
data = dead.dataset
arrived = data["solve_time"].to_numpy()
waits = np.diff(arrived, prepend=0.0)
print(f"longest silence {waits.max():.2f} s, {dead.messages_lost} of {dead.messages} messages lost")

first = int(np.argmax(waits))
print(f"the solve after it: {data['status'].values[first]}")

figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
error = np.linalg.norm(dead.online_error().sel(state=["z1", "z2", "z3"]), axis=1)
axes.plot(dead.t, error, color="#0072B2", label="error of the position")
axes.vlines(arrived, 0, 0.06, transform=axes.get_xaxis_transform(), color="#009E73", lw=0.9, label="arrived")
sent = np.setdiff1d(dead.sample_times.round(6), arrived.round(6))
axes.vlines(sent, 0.94, 1.0, transform=axes.get_xaxis_transform(), color="#D55E00", lw=0.9, label="lost")
axes.set(xlabel="time [s]", ylabel="[m]", xlim=(0, UNTIL))
axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.18))
plt.show()
