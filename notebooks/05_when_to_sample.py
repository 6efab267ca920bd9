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
# # When to sample a batch reactor
# Fifty samples in five seconds: where do they do most for the estimate? Equal gaps, dense at first, where the signal
# moves, where the prediction fails, where the estimator is unsure. Same reactor (thesis 3.4.1), same channel, same
# noise for all: only the instants differ.
#
# This notebook runs a few seeds; `CTMHE_SIZE=large` runs a hundred. The same study over both channels, with more
# policies, is `ctmhe reproduce study-reactor-budget`, and its numbers are in `docs/reproduced.md`.

# %%
import os

import matplotlib.pyplot as plt
import numpy as np

from ctmhe import (
    MHE,
    RK4,
    CovarianceBound,
    DiscountedCost,
    Innovation,
    LinearGaps,
    MaxInterval,
    OdePlant,
    Periodic,
    SendOnDelta,
    SingleSample,
    Study,
    Uniform,
    find_threshold,
    pareto_front,
    simulate,
)
from ctmhe.models.library import batch_reactor
from ctmhe.plotting import (
    plot_error_against_samples,
    plot_gap_histogram,
    plot_paired_differences,
    plot_pareto,
    plot_run,
)

LARGE = os.environ.get("CTMHE_SIZE") == "large"
SEEDS, TUNED_ON = (100, range(1000, 1012)) if LARGE else (5, range(1000, 1002))
BUDGET, UNTIL, WORKERS = 50, 5.0, os.cpu_count() if LARGE else 1

# %% [markdown]
# ## The case
# Two partial pressures, one measured sum. The first guess is far off: (0.1, 4.5) bar for a reactor at (3, 1). A sample
# is one noisy value of the pressure, |v| <= 0.1 bar, entering the cost at its own instant.

# %%
model = batch_reactor()
plant = OdePlant(model)
mhe = MHE(
    model,
    horizon=2.0,
    interval=0.01,
    integrator=RK4(0.01),
    cost=DiscountedCost(
        eta=0.4,
        P=2 * np.array([[4.009, 3.768], [3.768, 3.549]]),
        Q=2 * np.diag([1e3, 1e3, 1e2]),
        R_point=10.0,
    ),
    bounds=model.bounds,
    hold="point",
)


def run_with(*, seed, policy):
    """A run, and the error after the first second, when the wrong guess is forgotten."""
    run = simulate(
        plant,
        mhe,
        trigger=policy,
        until=UNTIL,
        guess=[0.1, 4.5],
        truth=[3.0, 1.0],
        channel=SingleSample(),
        disturbance=Uniform(0.1, interval=0.01),
        monitor=0.01,
        seed=seed,
    )
    return run, {"settled_rms": run.online_rms(since=1.0)}


# %% [markdown]
# ## Equal budgets
# A threshold is no budget. `find_threshold` searches the one that spends fifty samples on average, on seeds that the
# comparison does not use. Every event-triggered policy waits half a second at most.

# %%
families = {
    "send-on-delta": (SendOnDelta, (0.05, 0.3)),
    "innovation": (Innovation, (0.05, 0.3)),
    "covariance": (CovarianceBound, (0.3, 3.0)),
}


def made(family, threshold):
    return families[family][0](threshold) | MaxInterval(0.5)


period = UNTIL / BUDGET
policies = {
    "equidistant": Periodic(period, start=period),
    "equidistant, at once": Periodic(UNTIL / (BUDGET - 1)),
    "dense first": LinearGaps(0.01, 2 * period - 0.01, BUDGET),
}
thresholds = {}
for family, (_, bracket) in families.items():
    found = find_threshold(
        lambda *, seed, threshold, family=family: run_with(seed=seed, policy=made(family, threshold)),
        "threshold",
        bracket,
        target={"samples": BUDGET},
        seeds=TUNED_ON,
        tolerance=0.02 if LARGE else 0.06,
        workers=WORKERS,
    )
    thresholds[family], policies[family] = found.value, made(family, found.value)
    print(f"{family:14} {found.value:.4f} bar: {found.mean:.1f} samples on average ({found.message})")

# %% [markdown]
# ## Paired seeds
# Every policy meets the same disturbance and noise, so that differences are taken seed by seed.

# %%
result = Study(run_with, {"policy": policies}, SEEDS, trajectories=False).run(workers=WORKERS)
result.means("samples", "online_rms", "settled_rms").round(3)

# %%
fair = {"policy": "equidistant, at once"}
compared = {name: result.compare(name, fair) for name in ("online_rms", "settled_rms")}
figure, panels = plt.subplots(1, 2, figsize=(9, 2.8), layout="constrained", sharey=True)
titles = ("whole run", "after the first second")
for axes, table, title in zip(panels, compared.values(), titles, strict=True):
    plot_paired_differences(table, axes, xlabel="difference of the online RMS error [bar]")
    axes.set_title(title)
plt.show()

# %% [markdown]
# Most of the error of a whole run is that of its first tenths of a second. Whoever waits for the first sample pays for
# the wrong guess all the while: equal gaps whose first sample comes after one gap lose to anything that samples at
# once. So everything is compared with the clock that begins at t = 0, and most of the gain is gone in the left picture;
# the right one leaves the first second out. There samples are worth more where the prediction fails; the covariance
# knows nothing of that, and spends its budget early, when the prior is uncertain.

# %%
one = compared["online_rms"].set_index("policy")
assert one["low"]["equidistant"] > 0, "a late first sample is what a wrong guess costs most"
other = compared["settled_rms"].set_index("policy")
assert other["high"]["innovation"] < 0, "the innovation's samples are better ones"
compared["settled_rms"].drop(columns="dropped").round(4)

# %% [markdown]
# ## Where the samples lie
# One run of the innovation's policy: the level is the distance of the output from its prediction minus the threshold;
# a sample is due where it reaches zero. Early on it is far from the prediction, later nearly all of it is noise.

# %%
run, _ = run_with(seed=0, policy=policies["innovation"])
panels = plot_run(run.dataset)
plt.show()
print(run.dataset.attrs["location"])

# %%
runs = {name: run_with(seed=0, policy=policy)[0] for name, policy in policies.items() if name != "equidistant"}
axes = plot_gap_histogram(runs, bins=25)
plt.show()

# %% [markdown]
# ## Error against samples
# A budget of fifty is one point of a curve. Each family moves along its own as its threshold,
# or its period, is scaled.

# %%
scales = (1.0, 1.6) if not LARGE else (0.5, 0.7, 1.0, 1.4, 2.0)
points = [
    {"family": family, "scale": scale, "policy": made(family, thresholds[family] * scale)}
    for family in families
    for scale in scales
] + [
    {"family": "equidistant", "scale": scale, "policy": Periodic(period * scale, start=period * scale)}
    for scale in scales
]


def moved(*, seed, family, scale, policy):
    return run_with(seed=seed, policy=policy)


curve = Study(moved, points, 3 if not LARGE else 30).run(workers=WORKERS)
plot_error_against_samples(curve.table, error="settled_rms", by="family", parameter="scale")
plt.show()

# %%
plot_pareto(curve.table, x="samples", y="settled_rms", by="family", parameter="scale")
plt.show()

# %%
means = curve.means("samples", "settled_rms").drop(columns="policy")
pareto_front(means, minimise=["samples", "settled_rms"]).round(3)
