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
# # Cascaded tanks: real data, a level nobody measures, four unknown parameters
# A pump fills the upper tank, which drains into the lower one, whose level is measured every 4 s. Both can overflow.
# One record of 68 minutes serves for estimation, a second one for validation (Schoukens, Mattsson, Wigren and Noël
# 2016). The upper level appears in neither.
#
# 1. One window over the whole first record estimates (x, p) together.
# 2. On the second record, p is held: how well do MHE and a plain EKF predict one step, and the rest of the record?

# %%
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from ctmhe import MHE, RK4, DiscountedCost, Input, Measurement
from ctmhe.models.library import cascaded_tanks

NAMES = ("k1", "k2", "k3", "k4")
model = cascaded_tanks(noise=False, parameters=NAMES)  # the output residual is the noise; w drives the two levels
BLACK, ORANGE, BLUE = "#000000", "#D55E00", "#0072B2"
plt.rcParams.update(
    {
        "figure.dpi": 75,
        "axes.grid": True,
        "grid.color": "#dddddd",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
    }
)
print(model)


# %% [markdown]
# ## Data
# The records lie outside the repository. Where they are missing, two simulated ones take their place, so that the
# code below runs; every table and figure names its source.


# %%
def rk4(f, x, step, parts=4):
    """Classic Runge-Kutta in `parts` steps, on numbers or symbols."""
    h = step / parts
    for _ in range(parts):
        a = f(x)
        b = f(x + h / 2 * a)
        c = f(x + h / 2 * b)
        d = f(x + h * c)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


STEP = 4.0  # s
x, u, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p", 4)
advance = ca.Function("advance", [x, u, p], [rk4(lambda z: model.dynamics(0, z, u, [0, 0], p), x, STEP)])


def simulated(seed, n=256):
    """A short stand-in record: the same model with parameters of its own, disturbed."""
    rng = np.random.default_rng(seed)
    k = np.arange(n)
    pump = 2.8 + 0.8 * np.sin(k / 40 + rng.uniform(0, 6)) + 0.7 * np.sin(k / 17 + rng.uniform(0, 6))
    level, at = np.empty(n), np.array([5.0, 5.0])
    for i in k:
        level[i] = at[1] + rng.normal(0, 0.03)
        at = np.asarray(advance(at, pump[i], [0.048, 0.045, 0.046, 0.042])).ravel() + rng.normal(0, 0.02, 2)
    return pump, level


here = Path.cwd()
root = next((folder for folder in (here, *here.parents) if (folder / "pyproject.toml").exists()), here)
file = root / ".." / "shared" / "data" / "cascaded_tanks" / "dataBenchmark.csv"
if file.exists():
    table = pd.read_csv(file)
    first, second = (tuple(table[name + half].to_numpy() for name in "uy") for half in ("Est", "Val"))
    SOURCE = "Benchmark record"
else:
    first, second = simulated(1), simulated(2)
    SOURCE = "SIMULATED STAND-IN, not the benchmark"
    print(
        "Real data skipped: ../shared/data/cascaded_tanks/dataBenchmark.csv (from the repository's root) is not here."
    )
print(f"{SOURCE}: {len(first[0])} + {len(second[0])} samples, {STEP:g} s apart")

# %% [markdown]
# ## One window over the whole first record
# Every weight is an inverse covariance: the sensor's standard deviation is 0.05 V, `sigma` [V/√s] says how far the
# levels may wander from the model, and the prior is wide (the parameters start at the same round 0.05 ± 0.02).
# `horizon` exceeds the record, so this is full information estimation: 2048 unknown disturbances, 4 parameters.

# %%
NOISE, GUESS, SPREAD = 0.05, np.full(4, 0.05), np.full(4, 0.02)


def tanks_mhe(sigma, horizon, P):
    """P over two states holds the parameters; over two states and four parameters it estimates them."""
    cost = DiscountedCost(P=P, Q=1 / sigma**2, R_point=1 / NOISE**2)
    return MHE(
        model,
        horizon=horizon,
        interval=STEP,
        integrator=RK4(step=1.0),
        cost=cost,
        bounds=model.bounds,
        hold="point",
        max_iterations=200,
    )


def fit(record, sigma):
    mhe = tanks_mhe(sigma, 5000.0, P=1 / np.r_[2.0, 0.5, SPREAD] ** 2)
    state = mhe.init(t=0.0, x=[5.0, record[1][0]], p=GUESS)
    for k, (pump, level) in enumerate(zip(*record, strict=True)):
        state = mhe.control(state, Input(STEP * k, [pump]))
        state = mhe.observe(state, Measurement(STEP * k, [level]))
    return mhe.estimate(state, STEP * (len(record[0]) - 1))[1]


SIGMAS = (0.1, 0.03, 0.01)
fits = {sigma: fit(first, sigma) for sigma in SIGMAS}
for sigma, estimate in fits.items():
    status = estimate.status
    print(f"sigma {sigma:<6g} {status}; {status.iterations} iterations, {estimate.seconds:.1f} s")

# %% [markdown]
# The window reconstructs the level that has no sensor, with its uncertainty at the end of the window, and the
# disturbance shows where the model needs help.

# %%
best = fits[0.03]
minutes = best.trajectory.t / 60
figure, axes = plt.subplots(3, 1, figsize=(9, 6.5), sharex=True, layout="constrained")
axes[0].plot(STEP / 60 * np.arange(len(first[1])), first[1], color=BLACK, lw=3, alpha=0.3, label="lower, measured")
axes[0].plot(minutes, best.trajectory.x[:, 1], color=BLUE, lw=1, label="lower, estimated")
axes[1].plot(minutes, best.trajectory.x[:, 0], color=ORANGE, lw=1.2, label="upper, estimated, never measured")
deviation = np.sqrt(best.covariance[0, 0])
axes[1].errorbar(
    minutes[-1],
    best.x[0],
    yerr=2 * deviation,
    color=ORANGE,
    capsize=4,
    clip_on=False,
    label=f"±2 std = ±{2 * deviation:.2f} V",
)
axes[2].plot(minutes[:-1], 1e3 * best.trajectory.w[:, 0], color=ORANGE, lw=0.8, label="w_upper")
axes[2].plot(minutes[:-1], 1e3 * best.trajectory.w[:, 1], color=BLUE, lw=0.8, label="w_lower")
for axis in axes[:2]:
    axis.axhline(10.0, color="#999999", lw=0.8, ls="--")
    axis.set(ylabel="level [V]", ylim=(0, 11.5))
axes[2].set(ylabel="disturbance [mV/s]", xlabel=f"time [min], {SOURCE.lower()} 1 (dashed: rim)")
for axis in axes:
    axis.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0.1)
axes[0].set_xlim(0, minutes[-1])
plt.show()


# %% [markdown]
# ## A plain EKF on the same model, with the same weights
# Continuous-discrete, state and parameters stacked; its Riccati equation is integrated beside the state.

# %%
z, S, q = ca.vertcat(x, p), ca.MX.sym("S", 6, 6), ca.MX.sym("q")
rate = ca.vertcat(model.dynamics(0, x, u, [0, 0], p), ca.MX(4, 1))
A, G = ca.jacobian(rate, z), ca.diag(ca.vertcat(q, q, 0, 0, 0, 0))
both = ca.Function("both", [z, S, u, q], [ca.vertcat(rate, ca.vec(A @ S + S @ A.T + G))])


def split(v):
    return v[:6], ca.reshape(v[6:], 6, 6)


moments = ca.vertcat(z, ca.vec(S))
ekf_step = ca.Function("ekf_step", [moments, u, q], [rk4(lambda v: both(*split(v), u, q), moments, STEP)])


def ekf(record, sigma, p, spread):
    """Return one-step predictions of the level (n,) and filtered (x, p) (n, 6)."""
    mean, S = np.r_[5.0, record[1][0], p], np.diag(np.r_[2.0, 0.5, spread] ** 2)
    predicted, filtered = [], []
    for pump, level in zip(*record, strict=True):
        predicted.append(mean[1])
        gain = S[:, 1] / (S[1, 1] + NOISE**2)
        mean, S = mean + gain * (level - mean[1]), S - np.outer(gain, S[1])
        filtered.append(mean)
        value = np.asarray(ekf_step(np.r_[mean, S.ravel(order="F")], pump, sigma**2)).ravel()
        mean, S = value[:6], value[6:].reshape(6, 6)
        S = (S + S.T) / 2
    return np.array(predicted), np.array(filtered)


found = {("MHE, whole record", sigma): estimate.p for sigma, estimate in fits.items()}
found |= {("EKF, last value", sigma): ekf(first, sigma, GUESS, SPREAD)[1][-1, 2:] for sigma in SIGMAS}


# %% [markdown]
# ## The second record
# p is held at what the first record gave. Both filters run through the record; what they predict for the next sample
# gives the **one-step** error. After 100 s (25 samples) the measurements stop and the model runs alone to the end:
# the **free-run** error. MHE: a window of 40 s, prior weight = inverse covariance of the fit above.

# %%
WARM = 25


def mhe_one_step(record, sigma, p):
    """Return the same as `ekf` for a moving window."""
    mhe = tanks_mhe(sigma, 40.0, P=np.linalg.inv(fits[sigma].covariance[:2, :2]))
    state = mhe.init(t=0.0, x=[5.0, record[1][0]], p=p)
    predicted, filtered, seconds = [], [], []
    for k, (pump, level) in enumerate(zip(*record, strict=True)):
        t = STEP * k
        predicted.append(mhe.predict(state, t).y[0] if k else record[1][0])
        state = mhe.observe(mhe.control(state, Input(t, [pump])), Measurement(t, [level]))
        state, estimate = mhe.estimate(state, t)
        filtered.append(estimate.x)
        seconds.append(estimate.seconds)
    return np.array(predicted), np.array(filtered), np.median(seconds)


def free_run(start, record, p):
    at, level = start, []
    for pump in record[0]:
        level.append(at[1])
        at = np.asarray(advance(at, pump, p)).ravel()
    return np.minimum(level, 10.0)  # the sensor's limit, which both records touch


def rms(error):
    return float(np.sqrt(np.mean(np.square(error))))


later = tuple(signal[WARM:] for signal in second)
SIGMA = 0.03
rows, curves = {}, {}
for who in ("EKF, last value", "MHE, whole record"):
    p_held = found[who, SIGMA]
    by_ekf, x_ekf = ekf(second, SIGMA, p_held, np.zeros(4))
    by_mhe, x_mhe, seconds = mhe_one_step(second, SIGMA, p_held)
    curves[f"p from {who}"] = alone = free_run(x_mhe[WARM], later, p_held)
    rows[f"p from {who}"] = {
        "one step, EKF": rms(by_ekf[WARM:] - later[1]),
        "one step, MHE": rms(by_mhe[WARM:] - later[1]),
        "free run from EKF": rms(free_run(x_ekf[WARM, :2], later, p_held) - later[1]),
        "free run from MHE": rms(alone - later[1]),
    }
curves["p as guessed"] = free_run(ekf(second, SIGMA, GUESS, np.zeros(4))[1][WARM, :2], later, GUESS)
persistence = rms(np.diff(second[1])[WARM - 1 :])
print(f"RMS error in V on the second record ({SOURCE}), sigma = {SIGMA:g} V/√s")
print(f"for scale: 'the level stays as it is' errs {persistence:.3f} V in one step;", end=" ")
print(f"p as guessed errs {rms(curves['p as guessed'] - later[1]):.2f} V in the free run")
print(f"median time of one MHE update: {1e3 * seconds:.1f} ms")
pd.DataFrame(rows).T.round(3)

# %%
figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained", height_ratios=[2, 1])
minutes = STEP / 60 * (WARM + np.arange(len(later[1])))
axes[0].plot(minutes, later[1], color=BLACK, lw=3, alpha=0.3, label="measured")
for (who, curve), color, style in zip(curves.items(), (ORANGE, BLUE, "#999999"), ("--", "-", ":"), strict=True):
    axes[0].plot(minutes, curve, color=color, ls=style, lw=1.2, label=who)
    axes[1].plot(minutes, curve - later[1], color=color, ls=style, lw=1.2)
axes[0].set(ylabel="lower level [V]", xlim=(minutes[0], minutes[-1]))
axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=4, borderaxespad=0.1)
axes[1].set(ylabel="error [V]", xlabel=f"time [min], free run on {SOURCE.lower()} 2", ylim=(-2.5, 2.5))
plt.show()

# %% [markdown]
# ## How much does sigma matter?
# It is the one number chosen by hand. Parameters by either method, and the free-run error on record 2 that they lead
# to:

# %%
rows = {}
for (who, sigma), p_held in found.items():
    start = ekf(second, sigma, p_held, np.zeros(4))[1][WARM, :2]
    error = rms(free_run(start, later, p_held) - later[1])
    rows[f"p from {who}", sigma] = dict(zip(NAMES, p_held.round(4), strict=True)) | {"free run [V]": round(error, 3)}
print(SOURCE + "s")
pd.DataFrame(rows).T.rename_axis(["", "sigma"])

# %% [markdown]
# What the numbers say:
# - **Filtering is not where the two differ.** With the same p, MHE and EKF predict one step equally well: the model
#   is nearly linear over one step, and a mean and a covariance summarise the past well.
# - **Parameters are.** The EKF linearises once, along a trajectory that starts with wrong parameters, and never
#   returns; its last value depends on sigma. The window re-linearises 68 minutes until they agree, and its p hardly
#   moves. (One pass against the whole record at once: iterating or smoothing would narrow the gap.)
# - The free run ends near 0.5 V with either state: what is left is the model. w shows where it lacks something: when
#   tanks spill, and in two sudden drops of the lower level (real record 1, minutes 24 and 63).
