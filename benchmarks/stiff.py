"""A stiff window: van der Pol, mu = 100, as Python model and as FMU, under CVODES and under RK4 of several steps.

    python -m benchmarks.stiff

The truth is the model itself, undisturbed, from (2, 0); its position is sampled every 20 s with uniform noise of 1e-3
for 60 s. Prints the error of the estimate, of the open-loop prediction 10 s ahead (what an event-triggered estimator
lives on between samples), and the time of one converged solve (the faster of 2).
"""

from __future__ import annotations

import time

import numpy as np

from ctmhe import CVODES, MHE, RK4, ContinuousModel, DiscountedCost, FmuModel, Measurement, OdePlant
from ctmhe.models.library import van_der_pol
from fmus.build import build

MU, UNTIL, EVERY, AHEAD, NOISE = 100.0, 60.0, 20.0, 10.0, 1e-3


def record() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return sampling times, noisy outputs, and the true states at the end and `AHEAD` seconds later."""
    model = van_der_pol(mu=MU, noise=False)
    plant = OdePlant(model, rtol=1e-12, atol=1e-13)
    nothing, w = np.empty(0), np.zeros(len(model.w))
    plant.start(0.0, np.array([2.0, 0.0]))
    times = np.arange(0, round(UNTIL / EVERY) + 1) * EVERY
    rows = []
    for t in times:
        if t > 0:
            plant.advance(float(t), nothing, nothing, w)
        rows.append(plant.output(nothing, w))
    end = plant.state().copy()
    plant.advance(UNTIL + AHEAD, nothing, nothing, w)
    noise = np.random.default_rng(0).uniform(-NOISE, NOISE, (len(times), 1))
    return times, np.array(rows) + noise, end, plant.state()


def solve(model: ContinuousModel | FmuModel, integrator: RK4 | CVODES) -> tuple[float, float, float, str]:
    """Return the errors of estimate and prediction, milliseconds a solve, and the status."""
    times, rows, end, later = record()
    cost = DiscountedCost(P=1.0, Q=1e4, R=1e6, eta=0.95)
    mhe = MHE(model, horizon=60.0, interval=EVERY, integrator=integrator, cost=cost, hold="point")
    state = mhe.init(x=[1.9, 0.0])
    with np.errstate(all="ignore"):
        ahead = mhe.propagate(state, UNTIL, UNTIL + AHEAD, end, np.asarray(model.p_start))
    if not np.isfinite(ahead).all():  # not even the truth can be carried forward: no window can be solved in earnest
        return float("nan"), float("nan"), float("nan"), "diverges from the true state"
    for t, row in zip(times, rows, strict=True):
        state = mhe.observe(state, Measurement(float(t), row))
    for t in (20.0, 40.0):
        state, _ = mhe.estimate(state, t)
    seconds, after, estimate = [], state, None
    for _ in range(2):
        began = time.perf_counter()
        after, estimate = mhe.estimate(state, UNTIL)
        seconds.append(time.perf_counter() - began)
    assert estimate is not None
    with np.errstate(all="ignore"):
        predicted = mhe.predict(after, UNTIL + AHEAD).x
    errors = [float(np.abs(x - truth).max()) for x, truth in ((estimate.x, end), (predicted, later))]
    return *errors, 1e3 * min(seconds), estimate.status.outcome.value


def main() -> None:
    """Print the table."""
    models = {
        "Python": van_der_pol(mu=MU, noise=False),
        "FMU": FmuModel(build("van_der_pol", fmi=2), inputs=[], start={"mu": MU}),
    }
    integrators = [CVODES(1e-6, 1e-8), CVODES(1e-8, 1e-10), *(RK4(step) for step in (0.1, 0.05, 0.01, 0.005))]
    print(f"{'model':8}{'integrator':34}{'estimate':>12}{'prediction':>12}{'ms':>10}  status")
    for name, model in models.items():
        for integrator in integrators:
            error, ahead, milliseconds, status = solve(model, integrator)
            print(f"{name:8}{integrator!s:34}{error:12.2e}{ahead:12.2e}{milliseconds:10.1f}  {status.split(':')[0]}")


if __name__ == "__main__":
    main()
