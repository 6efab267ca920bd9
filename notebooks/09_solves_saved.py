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
# # Solves saved at equal error
# Standard moving horizon estimation solves at every step. Event-triggered, it solves when its own prediction of the
# output has failed, and goes on in open loop otherwise. The data are the same: the whole signal arrives with the next
# solve. How many solves can be left out before the online error grows, and would a clock have done as well?
#
# A few seeds here, `CTMHE_SIZE=large` for more; `ctmhe reproduce study-solves-saved` is the full claim, its numbers are
# in `docs/reproduced.md`.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from ctmhe import (
    MHE,
    RK4,
    DiscountedCost,
    Innovation,
    LinearGaps,
    MaxInterval,
    OdePlant,
    Periodic,
    Study,
    Uniform,
    WholeSignal,
    simulate,
)
from ctmhe.models.library import batch_reactor
from ctmhe.plotting import plot_error_against_samples, plot_solve_times

LARGE = os.environ.get("CTMHE_SIZE") == "large"
SEEDS = 40 if LARGE else 4
STEP, UNTIL = 0.01, 5.0

# %% [markdown]
# ## The reactor of thesis 3.4.1
# T = 2 s, cells and RK4 steps of 0.01 s, the output recorded every 0.01 s and held: 200 cells in a full window.

# %%
model = batch_reactor()
plant = OdePlant(model)
mhe = MHE(
    model,
    horizon=2.0,
    interval=STEP,
    integrator=RK4(STEP),
    cost=DiscountedCost(
        eta=0.4,
        P=2 * np.array([[4.009, 3.768], [3.768, 3.549]]),
        Q=2 * np.diag([1e3, 1e3, 1e2]),
        R=1e2,
    ),
    bounds=model.bounds,
    hold="zero",
)


def run_with(*, seed, family, setting, policy):
    run = simulate(
        plant,
        mhe,
        trigger=policy,
        until=UNTIL,
        guess=[0.1, 4.5],
        truth=[3.0, 1.0],
        channel=WholeSignal(every=STEP),
        disturbance=Uniform(0.1, interval=STEP),
        monitor=STEP,
        seed=seed,
    )
    return run, {"settled_rms": run.online_rms(since=1.0)}


# %% [markdown]
# ## The curve
# The noise of the output is 0.1 bar at most, so thresholds below it fire on noise. The rivals know nothing: a clock
# that solves at equal intervals, and a schedule that is dense at first.

# %%
thresholds = (0.08, 0.1, 0.11, 0.13, 0.16, 0.2) if LARGE else (0.09, 0.11, 0.14)
periods = (0.02, 0.05, 0.1, 0.2) if LARGE else (0.05, 0.1, 0.2)
everything = {"family": "every step", "setting": STEP, "policy": Periodic(STEP)}
points = [everything]
points += [
    {"family": "innovation", "setting": level, "policy": Innovation(level) | MaxInterval(0.5)} for level in thresholds
]
points += [{"family": "periodic", "setting": period, "policy": Periodic(period, start=period)} for period in periods]
points += [{"family": "dense first", "setting": 50, "policy": LinearGaps(0.01, 0.19, 50)}]
result = Study(run_with, points, SEEDS).run(workers=os.cpu_count() if LARGE else 1)

means = result.means("solves", "online_rms", "settled_rms", "solve_seconds_total").drop(columns="policy")
base = means[means["family"] == "every step"].iloc[0]
means["solves saved %"] = 100 * (1 - means["solves"] / base["solves"])
means["solve time saved %"] = 100 * (1 - means["solve_seconds_total"] / base["solve_seconds_total"])
for name in ("online_rms", "settled_rms"):
    means[f"{name} ratio"] = means[name] / base[name]
means.drop(columns=["solve_seconds_total"]).round(3)


# %%
def on_a_logarithmic_scale(axes):
    axes.set_xscale("log")
    ticks = [25, 50, 100, 200, 500]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()


axes = plot_error_against_samples(result.table, samples="solves", by="family", parameter="setting")
axes.axhline(1.05 * base["online_rms"], color="#444444", lw=0.9, ls=":")
axes.annotate("5 % above every step", (0.99, 1.05 * base["online_rms"]), xycoords=("axes fraction", "data"),
              ha="right", va="bottom", fontsize=9)  # fmt: skip
on_a_logarithmic_scale(axes)
plt.show()

# %% [markdown]
# The whole error is dominated by the wrong guess: the sooner the first solve, the better, and a clock's first solve
# comes late. The schedule that is dense at first is the honest rival there: it saves as much and needs no event. What
# is left after the first second tells whether the later solves are well placed:

# %%
axes = plot_error_against_samples(result.table, error="settled_rms", samples="solves", by="family", parameter="setting")
on_a_logarithmic_scale(axes)
plt.show()

# %%
close = (means[["online_rms ratio", "settled_rms ratio"]] <= 1.05).all(axis=1)
good = means[(means["family"] == "innovation") & close]
best = good.loc[good["solves"].idxmin()]
print(
    f"threshold {best['setting']} bar: {best['solves']:.0f} of {base['solves']:.0f} solves, "
    f"{best['solves saved %']:.1f} % saved, error ratio {best['online_rms ratio']:.3f}, "
    f"after the first second {best['settled_rms ratio']:.3f}"
)
assert best["solves saved %"] >= 86

# %% [markdown]
# ## What a step costs
# Without a solve, a step still costs the prediction that the trigger compares with. Both, in this process:

# %%
runs = {
    "every step": run_with(seed=0, **everything),
    "innovation": run_with(seed=0, **points[2]),
}
axes = plot_solve_times({name: run for name, (run, _) in runs.items()})
plt.show()

# %%
import timeit

state = mhe.init(x=[0.1, 4.5])
prediction = min(timeit.repeat(lambda: mhe.predict(state, STEP), number=500, repeat=5)) / 500
solve = base["solve_seconds_total"] / base["solves"]
idle = base["solves"] - best["solves"]
spent = best["solve_seconds_total"] + idle * prediction
print(f"a solve {1e6 * solve:.0f} us, a prediction {1e6 * prediction:.1f} us")
print(f"computing saved with predictions counted: {100 * (1 - spent / base['solve_seconds_total']):.1f} %")
