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
# # A study on an FMU plant
# A building as an FMU, with inputs (weather, radiators) and parameters (thermal resistances). Nobody knows the
# resistances of the house at hand, so a policy has to be good for many houses: a Latin hypercube of them, each met by
# every policy with the same noise. The estimator has the FMU too, with the resistances of its catalogue, and estimates
# two of them along.
#
# `CTMHE_SIZE=large` runs more houses and seeds, on all processors.

# %%
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ctmhe import (
    MHE,
    RK4,
    DiscountedCost,
    FmuModel,
    FmuPlant,
    Gaussian,
    MaxInterval,
    Periodic,
    SendOnDelta,
    SingleSample,
    Study,
    simulate,
)
from ctmhe.plotting import plot_error_against_samples, plot_paired_differences, plot_run
from ctmhe.studies import latin_hypercube, status
from ctmhe.studies.report import write_report
from fmus.build import build

LARGE = os.environ.get("CTMHE_SIZE") == "large"
HOUSES, SEEDS, WORKERS = (30, 10, os.cpu_count()) if LARGE else (3, 2, 1)
HOUR, ZERO = 3600.0, 273.15
UNTIL, CELL = 24 * HOUR, 900.0
scratch = tempfile.TemporaryDirectory()
folder = Path(scratch.name)
fmu = build("building", out=folder)

# %% [markdown]
# ## The case
# A case gets its FMU by path and opens it itself, in whatever process it runs. Parameters of the plant come from the
# design, `house` is their names and values. The disturbance is heat that the FMU does not know of.

# %%
UNKNOWN_HEAT = {"w_T1": 6e-5, "w_T2": 6e-5}  # K/s: 60 W in a zone
NOISE = {"v_y_T1": 0.1, "v_y_T2": 0.1}  # K
model = FmuModel(fmu, outputs="y_T?", parameters="R_*")
spread = np.concatenate([np.full(4, 2.0), 0.5 * model.p_start])
disturbed = np.array([6e-5, 6e-5, 1e-6, 1e-6])
mhe = MHE(
    model,
    horizon=12 * HOUR,
    interval=CELL,
    integrator=RK4(CELL),
    cost=DiscountedCost(P=1 / spread**2, Q=1 / (disturbed**2 * CELL), R_point=1 / 0.1**2),
    hold="point",
)


def weather_and_heat(t):
    hour = t / HOUR % 24
    outdoor = ZERO + 2 + 4 * np.sin(2 * np.pi * (hour - 9) / 24)
    sun = 300 * max(np.sin(np.pi * (hour - 8) / 9), 0.0) * (8 < hour < 17)
    heat = 1800.0 if 6 <= hour < 9 or 16 <= hour < 21 else 300.0
    return {"T_out": outdoor, "solar": sun, "heat1": heat, "heat2": 0.8 * heat}


def live_in(*, seed, policy, R_zw, R_wo):
    with FmuPlant(fmu, outputs="y_T?", parameters={"R_zw": R_zw, "R_wo": R_wo}) as plant:
        run = simulate(
            plant,
            mhe,
            trigger=policy,
            until=UNTIL,
            guess=[ZERO + 18, ZERO + 18, ZERO + 14, ZERO + 14],
            truth=[ZERO + 19, ZERO + 17, ZERO + 13, ZERO + 12],
            channel=SingleSample(),
            disturbance={name: Gaussian(std, interval=CELL) for name, std in UNKNOWN_HEAT.items()}
            | {name: Gaussian(std, interval=300.0) for name, std in NOISE.items()},
            inputs=weather_and_heat,
            monitor=300.0,
            locate=1.0,
            seed=seed,
        )
    found = dict(zip(model.p.names, run.dataset["p_hat"].isel(solve=-1).to_numpy(), strict=True))
    return run, {"R_wo_error_percent": 100 * abs(found["R_wo"] / R_wo - 1)}


# %% [markdown]
# ## Houses and policies
# A signal that moves is sent; the clock comes at the same cost. Events are located on the FMU by going back, to one
# second here: the run says so.

# %%
delta = SendOnDelta(0.5) | MaxInterval(3 * HOUR)
first, _ = live_in(seed=0, policy=delta, R_zw=6e-3, R_wo=1.5e-2)
period = UNTIL / first.samples
policies = {"send-on-delta": delta, "clock": Periodic(period), "clock, twice": Periodic(period / 2)}
print(first)
print("located:", first.dataset.attrs["location"])
assert "rollback" in first.dataset.attrs["location"]

# %%
houses = latin_hypercube({"R_zw": (4e-3, 9e-3), "R_wo": (1e-2, 2.5e-2)}, HOUSES, seed=1)
study = Study(live_in, {"policy": policies}, SEEDS, design=houses, folder=folder / "houses", name="houses")
print(study)

# %% [markdown]
# ## Stopped, and gone on
# A finished run is on disk as soon as it is done, under a key of all that it depends on (FMUs by their content). So a
# study that was stopped, killed or given more seeds runs what is missing. Here the first seed, then all:

# %%
Study(live_in, {"policy": policies}, 1, design=houses, folder=folder / "houses", name="houses").run(workers=WORKERS)
print(study.status())
result = study.run(workers=WORKERS)
print(status(folder / "houses"))
assert len(result.table) == len(policies) * HOUSES * SEEDS
assert not len(result.failed)

# %%
mean = result.summary("online_rms", by="policy")
print(result.summary("samples", by="policy")[["policy", "mean", "low", "high"]].round(1))
mean.round(3)

# %%
difference = result.compare("online_rms", {"policy": "clock"}, by="policy")  # the same house, the same seed
figure, axes = plt.subplots(figsize=(7, 1.9), layout="constrained")
plot_paired_differences(difference, axes, xlabel="difference of the online RMS error to the clock [K]")
plt.show()

# %%
plot_error_against_samples(result.table, error="R_wo_error_percent", by="policy")
plt.show()

# %% [markdown]
# Above: how well the outer walls' resistance is found, over all houses. `SendOnDelta` samples along the slopes, where
# radiators go on and off; the walls, which nobody measures, follow slowly, and a clock serves them as well. A signal
# that moves is not yet a signal that surprises.
#
# ## One house
# The trajectories of a study can be kept (`trajectories=True`); a single run is done again as quickly.

# %%
panels = plot_run(first.dataset)
plt.show()

# %% [markdown]
# ## A report to hand on
# One HTML page with figures and tables, nothing else needed. `ctmhe study report houses` writes it from the folder. A
# case in a Python file and a `study.toml` do without a notebook (`docs/cli.md`), and `study.run(executor=client)` runs
# on a Dask cluster (`docs/clusters.md`): workers get the path of the FMU and check its digest.

# %%
page = write_report(result, folder / "houses.html")
print(f"{page.name}: {page.stat().st_size / 1e3:.0f} kB")
scratch.cleanup()
