"""Simulate: a plant runs, a trigger says when to sample, a channel carries, an estimator solves."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.estimators.base import Estimator
from ctmhe.models.continuous import Model
from ctmhe.simulation.channel import Channel, WholeSignal
from ctmhe.simulation.engine import Loop
from ctmhe.simulation.plants import MapPlant, Plant, as_plant
from ctmhe.simulation.run import Run
from ctmhe.simulation.signals import Drive, Inputs, bind_disturbance, bind_inputs, seed_of
from ctmhe.triggers.base import Trigger
from ctmhe.triggers.timing import tolerance
from ctmhe.types import Array, finite_time, frozen


def simulate(
    plant: Plant | Model,
    estimator: Estimator,
    *,
    trigger: Trigger,
    until: float,
    guess: Any,
    truth: Any = None,
    p: Any = None,
    p_true: Any = None,
    channel: Channel | None = None,
    disturbance: Drive = None,
    inputs: Inputs = None,
    monitor: float | None = None,
    locate: float | None = 1e-9,
    start: float = 0.0,
    seed: int | np.random.Generator = 0,
    progress: bool = False,
) -> Run:
    """Run a plant, sample it when the trigger says so, and estimate its state after every sample.

    At every event t_i the channel sends its measurements, and when they arrive (at once, unless the channel is a
    `Network`) the estimator solves the problem of the window that ends there. Between solves the *online* estimate is
    the open-loop prediction from the last one; the *retrospective* one is the estimated trajectory (thesis 3.16), which
    on (t_(i-1), t_i] uses what was known at t_i. Disturbance and noise depend on `seed` and the signals' names only,
    never on the policy, so that policies can be compared under the same noise.

    Guards are located between monitoring times: on a model as plant by CVODE, which looks for roots in each of its
    steps, so that the time of an event is as exact as the solution (`OdePlant(rtol=)`); on other plants (FMUs, or
    without scikits.odes) by going back and advancing anew until the event is known to `locate` seconds, where a guard
    that crosses zero and back between two breaks (monitoring times, jumps of signals) is not seen. A guard that is
    back at zero within a hundredth of the monitoring step, three samples in a row, is silent until the next
    monitoring time (`Run.hushed`).

    Parameters
    ----------
    plant : Plant or Model
        A model is integrated by `OdePlant` (`MapPlant` when discrete). Signals are matched with the estimator's by
        name. It is started anew and left open.
    estimator : Estimator
        `MHE`, a `KalmanFilter`, or anything else with their verbs.
    trigger : Trigger
    until : float
        End of the run, seconds.
    guess : array (nx,) or mapping
        Initial estimate chi_hat, in the units of the estimator's model.
    truth : array (nx,) or mapping, optional
        True state at `start`; the plant's own when left out.
    p : array (np,) or mapping, optional
        Initial (or known) parameters of the estimator.
    p_true : array (np,) or mapping, optional
        Parameters of the plant.
    channel : Channel, optional
        `WholeSignal()` when left out.
    disturbance : process, or mapping name -> process or constant, optional
        Such as `Uniform(1e-3)`; zero when left out.
    inputs : values, callable t -> values, list of Input, or Recorded, optional
        Known inputs; the estimator is told as they happen. A function is sampled at monitoring times and held. Linear
        ones want an estimator with `input_hold="linear"`. The start values of an FMU when left out.
    monitor : float, optional
        Monitoring step in seconds: multiples of it are the times at which policies are asked and results are kept.
        0.01 when left out, the step of a discrete-time plant or model, whose guards are asked at monitoring times only.
    locate : float, optional
        Seconds to which guards are located where that is done by going back; None asks them at monitoring times only.
        `run.dataset.attrs["location"]` says what was done.
    start : float
        Start of the run, seconds.
    seed : int or Generator
    progress : bool
        Show a progress bar.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        For signals that do not match, a declared wait that is not shorter than the horizon (thesis 3.19), a channel
        that does not fit the estimator's `hold`, a time step that a discrete-time plant cannot make.
    TriggerError
        When the policy raises, returns what is not an answer, or fires without end. As on every error in mid-run,
        `error.run` is the `Run` up to there.
    SolverError
        When the plant cannot be integrated.
    FmuUnsupportedError
        When guards are to be located on an FMU that cannot go back.
    """
    plant = as_plant(plant)
    start, until = finite_time(start, "simulate: start"), finite_time(until, "simulate: until")
    if not until > start:
        raise InputError(f"simulate: until = {until:g} s must come after start = {start:g} s")
    step = plant.step if isinstance(plant, MapPlant) else estimator.model.step
    if monitor is None:
        monitor = 0.01 if step is None else step
    monitor = finite_time(monitor, "simulate: monitor")
    if monitor <= 0:
        raise InputError(f"simulate: monitor must be a positive number of seconds, got {monitor:g}")
    if locate is not None and finite_time(locate, "simulate: locate") <= 0:
        raise InputError(f"simulate: locate must be a positive number of seconds, or None, got {locate:g}")
    number = seed_of(seed)
    if inputs is None:
        inputs = getattr(plant, "u_start", getattr(getattr(plant, "model", None), "u_start", None))
    loop = Loop(
        plant,
        estimator,
        trigger=trigger,
        channel=channel or WholeSignal(),
        disturbance=bind_disturbance(disturbance, plant.w, number),
        inputs=bind_inputs(inputs, plant.u, monitor),
        times=monitoring_times(start, until, monitor),
        monitor=monitor,
        seed=number,
        locate=locate if step is None else None,
    )
    return loop.run(truth=truth, p_true=p_true, guess=guess, p=p, progress=progress)


def monitoring_times(start: float, until: float, monitor: float) -> Array:
    """Return `start`, the multiples of `monitor` in between, and `until`; no rounding accumulates."""
    slack = tolerance(max(abs(start), abs(until)))
    first, last = int(np.ceil((start + slack) / monitor)), int(np.floor((until - slack) / monitor))
    if last - first > 10_000_000:
        raise InputError(f"monitor = {monitor:g} s makes {last - first} monitoring times; choose a longer step")
    inside = [k * monitor for k in range(first, last + 1)]
    inside = [t for t in inside if start + slack < t < until - slack]
    return frozen([start, *inside, until])
