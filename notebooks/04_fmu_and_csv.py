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
# # From an FMU and a CSV to estimates
# A building of two zones has a thermometer in either zone and none in its walls. There is an FMU of it, whose thermal
# resistances come from a catalogue, and a log file of one winter week. Wanted: the temperatures of the walls, two
# resistances, and how few samples would do.
#
# The first cell makes the log file, so that everything here can be run again: another copy of the FMU plays the
# building, with two other resistances, weather, thermostats, people who come and go, and noise, all from one seed.
# Skip it: with a log of your own, start below it.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from ctmhe import (
    MHE,
    RK4,
    DiscountedCost,
    FmuModel,
    FmuPlant,
    Input,
    MaxInterval,
    Measurement,
    MeasurementLog,
    Periodic,
    SendOnDelta,
    replay,
)
from ctmhe.errors import InputError
from ctmhe.models.fmu import describe
from fmus.build import build

HOUR, DAY, ZERO = 3600.0, 86400.0, 273.15
NOISE = 0.1  # K, of the thermometers
CELL = 900.0  # s, for which a disturbance stays as it is
DISTURBED = np.array([6e-5, 6e-5, 1e-6, 1e-6])  # K/s: 60 W in a zone, 10 W in a wall
TRUTH = {"R_zw": 6.5e-3, "R_wo": 1.5e-2}  # K/W, of the building; the FMU says something else


def record(fmu, folder, days=7, seed=2):
    """Write what a logger would (building.csv), and what nobody knows (truth.csv)."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(np.round(rng.uniform(180, 420, int(days * 350))))  # about every five minutes
    t = np.concatenate([[0.0], t[t <= days * DAY]])
    hour, sky = t / HOUR % 24, rng.uniform(0.15, 1.0, days + 1)[(t / DAY).astype(int)]
    outdoor = ZERO + 2 + 3 * np.sin(2 * np.pi * t / (5 * DAY)) + 3.5 * np.sin(2 * np.pi * (hour / 24 - 0.4))
    sun = 450 * sky * np.clip(np.sin(np.pi * (hour - 8) / 8.5), 0, None) * (hour < 16.5)
    wanted, most = ZERO + np.array([21.0, 20.0]), np.array([3000.0, 2500.0])
    x, heat = np.empty((len(t), 4)), np.empty((len(t), 2))
    w = np.zeros((int(days * DAY / CELL) + 1, 7))
    w[:, :4] = DISTURBED * rng.standard_normal((len(w), 4))
    with FmuPlant(fmu, parameters=TRUTH) as plant:
        plant.start(0.0, {"T1": ZERO + 18, "T2": ZERO + 16.5, "Tw1": ZERO + 12.5, "Tw2": ZERO + 11.5})
        for k in range(len(t)):
            x[k] = plant.state()
            control = np.clip(1200 + 600 * (wanted - x[k, :2]), 0, most)
            heat[k] = np.round(control) if 6 < hour[k] < 21 else 0.0  # off at night
            u, now = np.array([outdoor[k], sun[k], *heat[k]]), t[k]
            while k + 1 < len(t) and now < t[k + 1]:
                cell = int(now // CELL)
                now = min((cell + 1) * CELL, t[k + 1])
                plant.advance(now, u, u, w[cell])
    seen = x[:, :2] - ZERO + NOISE * rng.standard_normal((len(t), 2))
    seen[(t > 4.3 * DAY) & (t < 4.9 * DAY), 1] = np.nan  # the thermometer of zone 2 is dead
    weather = np.where((np.arange(len(t)) % 3 == 0)[:, None], np.column_stack([outdoor - ZERO, sun]), np.nan).round(2)
    table = pd.DataFrame(
        {
            "time": pd.Timestamp("2025-01-13") + pd.to_timedelta(t, unit="s"),
            "zone 1 [degC]": seen[:, 0].round(3),
            "zone 2 [degC]": seen[:, 1].round(3),
            "outdoor [degC]": weather[:, 0],
            "sun [W/m2]": weather[:, 1],
            "radiator 1 [W]": heat[:, 0],
            "radiator 2 [W]": heat[:, 1],
        }
    )
    on = (t < 2.9 * DAY) | (t > 3.15 * DAY)  # for six hours of a night the logger is off
    table[on].to_csv(folder / "building.csv", index=False)
    pd.DataFrame(x, index=pd.Index(t, name="t"), columns=["T1", "T2", "Tw1", "Tw2"]).to_csv(folder / "truth.csv")


scratch = tempfile.TemporaryDirectory()
folder = Path(scratch.name)
fmu = build("building", out=folder)
record(fmu, folder)
BLACK, ORANGE, BLUE, GREEN = "#000000", "#D55E00", "#0072B2", "#009E73"
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

# %% [markdown]
# ## The two files
# `ctmhe fmu info building_fmi2.fmu` prints what the FMU offers, and so does

# %%
print(describe(fmu))

# %%
csv = folder / "building.csv"
pd.read_csv(csv).iloc[[0, 1, 2, 3, 1500]]

# %% [markdown]
# Rows come irregularly. The weather station speaks in every third of them; where a thermometer is dead its column is
# empty. Temperatures are in °C here, in K in the FMU.
#
# ## A model
# Signals are chosen by name or pattern: the outputs that are measured (not `loss`), and the parameters to estimate,
# which have to be tunable. All inputs of the FMU are known inputs, as that is the default. `w_<state>` is a heat that
# the FMU does not know of, one for each state.

# %%
model = FmuModel(fmu, outputs="y_T?", parameters="R_*")
print(model)
print("directional derivatives:", model.exact_derivatives, "| warnings:", model.warnings)

# %% [markdown]
# ## An estimator
# Weights are inverse (co)variances: the thermometers err by 0.1 K; people and windows are worth 60 W in a zone, redrawn
# every 15 min; the first guess of a temperature may be off by 3 K, a resistance of the catalogue by a half. Nothing is
# discounted (`eta` = 1, the default), so that covariances can be taken at their word.
#
# The building is slow: its fastest time constant is above half an hour. RK4 with steps of 15 min at most will do
# (checked below; steps end at samples and where an input changes, which is every few minutes here); a stiff FMU would
# get `CVODES()`, which takes far longer. The window of three days spans the slowest time constant, 2.6 days with the
# catalogue's values.


# %%
def estimator(model, horizon, step=CELL):
    spread = np.concatenate([np.full(4, 3.0), 0.5 * model.p_start])
    cost = DiscountedCost(P=1 / spread**2, Q=1 / (DISTURBED**2 * CELL), R_point=1 / NOISE**2)
    return MHE(model, horizon=horizon, interval=CELL, integrator=RK4(step), cost=cost, hold="point")


GUESS = {"T1": 293.0, "T2": 291.0, "Tw1": 288.0, "Tw2": 287.0}  # the FMU's start values, roughly
print(estimator(model, 3 * DAY))

# %% [markdown]
# ## Reading the log
# Signals are matched with columns by name.

# %%
COLUMNS = {
    "time": "time",
    "outputs": {"y_T1": "zone 1 [degC]", "y_T2": "zone 2 [degC]"},
    "inputs": {
        "T_out": "outdoor [degC]",
        "solar": "sun [W/m2]",
        "heat1": "radiator 1 [W]",
        "heat2": "radiator 2 [W]",
    },
}
try:
    MeasurementLog.from_csv(csv, **COLUMNS)
except InputError as error:
    print(error)

# %% [markdown]
# Outputs may be missing, inputs not: the estimator believes them to the letter and holds each until the next row. That
# matters where the logger was off. The outdoor temperature of the evening, held through the night, would be wrong by
# some kelvin, and the resistances would pay for it. So there are rows to be added: the weather interpolated,
# the radiators off, as they are every night, and nothing from the thermometers.

# %%
frame = pd.read_csv(csv, parse_dates=["time"]).set_index("time")
late = int(np.argmax(np.diff(frame.index)))
off, on = frame.index[late], frame.index[late + 1]
frame = frame.reindex(frame.index.union(pd.date_range(off, on, freq="5min", inclusive="neither")))
for column in ("outdoor [degC]", "sun [W/m2]"):
    frame[column] = frame[column].interpolate("time")
frame.loc[off:on] = frame.loc[off:on].fillna({"radiator 1 [W]": 0.0, "radiator 2 [W]": 0.0})
frame = frame.rename_axis("time").reset_index()

UNITS = {"y_T1": "degC", "y_T2": "degC", "T_out": "degC", "solar": "W/m2", "heat1": "W", "heat2": "W"}
log = MeasurementLog.from_dataframe(frame, **COLUMNS, units=UNITS)
try:
    replay(log, estimator(model, 3 * DAY), trigger=Periodic(HOUR), guess=GUESS)
except InputError as error:
    print(error)

# %% [markdown]
# The units were stated, so they were compared. Had they been left out, nobody would have complained, and a building
# would have been estimated at 20 K. Converted:

# %%
for signal in ("y_T1", "y_T2", "T_out"):
    frame[(COLUMNS["outputs"] | COLUMNS["inputs"])[signal]] += 273.15
    UNITS[signal] = "K"
log = MeasurementLog.from_dataframe(frame, **COLUMNS, units=UNITS)

days, between = log.t / DAY, np.diff(log.t) / 60
print(f"{len(log)} rows in {days[-1]:.2f} days; between rows {between.min():.0f} to {between.max():.0f} min")
print("empty:", dict(zip(log.outputs, np.isnan(log.y).sum(axis=0).tolist(), strict=True)))


def shade(axis):
    """Mark when there is no log, and when there is no thermometer in zone 2."""
    gap = days[np.isnan(log.y[:, 0])]
    axis.axvspan(gap[0], gap[-1], color="#cccccc", lw=0)
    silent = days[np.isnan(log.y[:, 1]) & ~np.isnan(log.y[:, 0])]
    axis.axvspan(silent[0], silent[-1], facecolor="none", edgecolor="#999999", hatch="//", lw=0)


figure, axes = plt.subplots(3, 1, figsize=(9, 5.5), sharex=True, layout="constrained")
line = {"lw": 0.8, "drawstyle": "steps-post"}
axes[0].plot(days, log.y[:, 0] - ZERO, ".", ms=1.5, color=ORANGE, label="zone 1")
axes[0].plot(days, log.y[:, 1] - ZERO, ".", ms=1.5, color=BLUE, label="zone 2")
axes[1].plot(days, log.u[:, 0] - ZERO, color=BLACK, label="outdoor [°C]", **line)
axes[1].plot(days, log.u[:, 1] / 10, color=GREEN, ls="--", lw=0.8, label="sun [10 W/m²]")
axes[2].plot(days, log.u[:, 2] / 1e3, color=ORANGE, label="radiator 1", **line)
axes[2].plot(days, log.u[:, 3] / 1e3, color=BLUE, label="radiator 2", **line)
for axis, label in zip(axes, ("measured [°C]", "weather", "heat [kW]"), strict=True):
    shade(axis)
    axis.set(ylabel=label, xlim=(0, days[-1]))
    axis.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0.1, markerscale=5)
axes[2].set_xlabel("time [days]; grey: no log, hatched: thermometer of zone 2 dead")
plt.show()

# %% [markdown]
# ## Which parameters does this log determine?
# One window over the whole week, for each choice of parameters: `rank` counts the directions of (x, p) that the data
# determine, the covariance says how well. A parameter is worth estimating when its standard deviation shrinks far
# below the catalogue's 50 %.


# %%
def whole_week(model, step=CELL):
    mhe = estimator(model, 8 * DAY, step)
    state = mhe.init(x=GUESS)
    for t, y, u in zip(log.t, log.y, log.u, strict=True):
        state = mhe.observe(mhe.control(state, Input(t, u)), Measurement(t, y))
    return mhe.estimate(state, log.t[-1])[1]


CHOICES = {
    "two": ["R_zw", "R_wo"],
    "all resistances": "R_*",
    "and capacities": ["R_*", "C_*"],
    "all that are tunable": "variability:tunable",
}
rows = {}
for label, names in CHOICES.items():
    chosen = FmuModel(fmu, outputs="y_T?", parameters=names)
    estimate = whole_week(chosen)
    assert estimate.status.success
    std = np.sqrt(np.diag(estimate.covariance))[4:] / estimate.p
    rows[label] = {"rank": f"{estimate.rank} of {4 + len(chosen.p)}"}
    rows[label] |= {f"{name} [%]": f"{100 * value:.1f}" for name, value in zip(chosen.p, std, strict=True)}
    chosen.close()
pd.DataFrame(rows).T.fillna("")

# %% [markdown]
# The week determines every choice, even all seven at once: the radiators' watts are known, so there is a scale, and
# every evening they go off, which shows the time constants. The resistance between the zones is known least of
# the three: the zones are kept nearly equally warm, and little flows through it. The more is left open,
# the less is known of each. We estimate the two that lead through the walls, and keep the rest as the FMU has it.
#
# Are the steps short enough?

# %%
PAIR = CHOICES["two"]
model.close()
model = FmuModel(fmu, outputs="y_T?", parameters=PAIR)
coarse, fine = (whole_week(model, step) for step in (CELL, CELL / 15))
std = np.sqrt(np.diag(coarse.covariance))
print("p               ", dict(zip(PAIR, coarse.p.round(5).tolist(), strict=True)), "K/W")
print("true            ", TRUTH)
print("std             ", dict(zip(PAIR, std[4:].round(5).tolist(), strict=True)))
moved = np.abs(np.concatenate([fine.x - coarse.x, fine.p - coarse.p])) / std
print(f"RK4 steps of at most {CELL / 900:g} instead of {CELL / 60:g} min move the estimate by {moved.max():.1g} std")

# %% [markdown]
# ## As it would have happened, under two triggers
# `replay` sends the log through a trigger and the estimator as if it were live; nothing looks ahead. Each thermometer
# could be a radio sensor on a battery that sends only when told: either a reading that has moved by 0.6 K since the
# last one sent (at the latest after 4 h), or by the clock, with as many samples.

# %%
HORIZON = 3 * DAY
mhe = estimator(model, HORIZON)
policies = {"send on delta": SendOnDelta(0.6) | MaxInterval(4 * HOUR)}
runs = {"send on delta": replay(log, mhe, trigger=policies["send on delta"], guess=GUESS)}
policies["periodic"] = Periodic(log.t[-1] / runs["send on delta"].samples)
runs["periodic"] = replay(log, mhe, trigger=policies["periodic"], guess=GUESS)
for run in runs.values():
    print(run)


# %% [markdown]
# A run keeps estimates; covariances come with each `Estimate`. So once more by hand, in three calls, at the instants
# and with the samples of the run:


# %%
def deviations(run):
    """Standard deviations of (x, p) after every sample."""
    state, row, found = mhe.init(t=log.t[0], x=GUESS), 0, []
    samples, estimates = (run.dataset[name].to_numpy() for name in ("y_sampled", "x_hat"))
    for t, y, x_hat in zip(run.sample_times, samples, estimates, strict=True):
        while row < len(log) and log.t[row] <= t:
            state, row = mhe.control(state, Input(log.t[row], log.u[row])), row + 1
        state = mhe.observe(state, Measurement(log.t[row - 1], y))
        state, estimate = mhe.estimate(state, t)
        assert np.allclose(estimate.x, x_hat, atol=1e-3)
        found.append(np.sqrt(np.diag(estimate.covariance)))
    return np.array(found)


std = {label: deviations(run) for label, run in runs.items()}
table = pd.read_csv(folder / "truth.csv")
truth = np.column_stack([np.interp(log.t, table["t"], table[state]) for state in model.x])
COLOURS = {"send on delta": ORANGE, "periodic": BLUE}

# %%
run = runs["send on delta"]
online, t = run.dataset["x_online"].to_numpy(), run.sample_times / DAY
figure, axes = plt.subplots(
    5, 1, figsize=(9, 9.5), sharex=True, layout="constrained", height_ratios=[3, 3, 2.2, 2.2, 1.2]
)
for axis, i in zip(axes[:2], (0, 2), strict=True):
    axis.plot(days, truth[:, i] - ZERO, color=BLACK, lw=2.5, alpha=0.35, label="true")
    axis.plot(days, online[:, i] - ZERO, color=ORANGE, lw=1, label="online estimate, send on delta")
    axis.plot(t, run.dataset["x_hat"].to_numpy()[:, i] - ZERO, ".", color=ORANGE, ms=4, label="at a sample")
    axis.set_ylabel(f"{model.x.names[i]} [°C]")
for axis, i in zip(axes[2:4], (2, 3), strict=True):
    for (label, result), style in zip(runs.items(), ("-", "--"), strict=True):
        error, width = result.dataset["x_online"].to_numpy()[:, i] - truth[:, i], 2 * std[label][:, i]
        at = result.sample_times / DAY
        axis.fill_between(at, -width, width, color=COLOURS[label], alpha=0.2, lw=0)
        axis.plot(days, error, color=COLOURS[label], lw=1, ls=style, label=label)
    axis.set(ylabel=f"error of {model.x.names[i]} [K]", ylim=(-1.5, 1.5))
for height, (label, result) in enumerate(runs.items()):
    axes[4].plot(result.sample_times / DAY, np.full(result.samples, height), "|", ms=9, mew=0.7, color=COLOURS[label])
axes[4].set(yticks=[0, 1], yticklabels=list(runs), ylim=(-0.6, 1.6), xlim=(0, days[-1]))
axes[4].set_xlabel("time [days]; bands: ±2 std at the samples; bottom: when samples are taken")
axes[4].grid(visible=False)
for axis in axes[:4]:
    shade(axis)
for axis in (axes[0], axes[2]):
    axis.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.1)
plt.show()

# %%
figure, axes = plt.subplots(3, 1, figsize=(9, 6.5), sharex=True, layout="constrained")
for (label, result), color, style in zip(runs.items(), COLOURS.values(), ("-", "--"), strict=True):
    t, p = result.sample_times / DAY, 1e3 * result.dataset["p_hat"].to_numpy()
    for i in range(2):
        width = 2e3 * std[label][:, 4 + i]
        axes[i].fill_between(t, p[:, i] - width, p[:, i] + width, color=color, alpha=0.2, lw=0)
        axes[i].plot(t, p[:, i], color=color, ls=style, lw=1.2, label=label)
    axes[2].plot(t, result.gaps / HOUR, color=color, ls="", marker=".^"[label == "periodic"], ms=4, label=label)
for axis, parameter in zip(axes, PAIR, strict=False):
    value = 1e3 * TRUTH[parameter]
    axis.axhline(value, color=BLACK, lw=0.8, label="true")
    axis.set(ylabel=f"{parameter} [K/kW]", ylim=(0.8 * value, 1.35 * value))
axes[2].set(ylabel="since last sample [h]", xlabel="time [days]; bands: ±2 std", xlim=(0, days[-1]), ylim=(0, 4.3))
axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.1)
plt.show()

# %%
settled, rows = log.t > DAY, {}
for label, result in runs.items():
    error = result.dataset["x_online"].to_numpy() - truth
    rms = np.sqrt(np.mean(error[settled] ** 2, axis=0))
    late = result.sample_times > DAY
    at_samples = np.searchsorted(log.t, result.sample_times[late], side="right") - 1
    inside = np.abs(result.dataset["x_hat"].to_numpy()[late] - truth[at_samples]) < 2 * std[label][late, :4]
    last = result.dataset["p_hat"].to_numpy()[-1] / list(TRUTH.values()) - 1
    rows[label] = {"samples": result.samples, "solves": result.solves}
    rows[label] |= {f"rms {state} [K]": f"{rms[i]:.2f}" for i, state in enumerate(model.x)}
    rows[label] |= {f"error {p} [%]": f"{100 * last[i]:.1f}" for i, p in enumerate(PAIR)}
    rows[label] |= {"walls inside ±2 std [%]": f"{100 * inside[:, 2:].mean():.0f}"}
    rows[label] |= {"median ms a solve": f"{1e3 * np.median(result.solve_seconds):.0f}"}
pd.DataFrame(rows)

# %%
model.close()
scratch.cleanup()

# %% [markdown]
# - **Both policies find the walls and the resistances**, from a small part of the rows and without a sensor in a wall.
#   One night of cooling down, and R_zw is known; R_wo takes a whole day, as heat has to get through a wall first.
# - **Through the gap** the model carries the estimate, and because the weather was filled in it stays close. **Without
#   the second thermometer** the first one goes on informing both walls, through the resistance between the zones.
# - Send on delta puts its samples where temperatures move. Here that is not worth more than a clock: what is unknown
#   moves slowly, and a reading that has just crossed a threshold has, more often than not, noise in that direction
#   (see the quick start). Compare policies on your own log before you choose; it takes seconds.
# - One week under one seed is an example. Other seeds: `record(fmu, folder, seed=...)`.
