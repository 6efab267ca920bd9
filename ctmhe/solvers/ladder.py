"""What to do when a solve fails: warm start, shifted guess, reference solver, relaxed bounds, open loop."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ctmhe.solvers.base import Solution, Solver
from ctmhe.transcription.problem import Guess, Window, bound_violation
from ctmhe.types import Outcome, Status

logger = logging.getLogger(__name__)


def climb(
    window: Window,
    solver: Solver,
    reference: Callable[[], Solver],
    guesses: Sequence[tuple[str, Callable[[], Guess]]],
    notes: tuple[str, ...],
    *,
    real_time: bool = False,
    evaluable: Callable[[], bool] = lambda: True,
    rescue: Callable[[], Guess] | None = None,
) -> tuple[Solution | None, Status]:
    """Try each rung until one succeeds.

    Parameters
    ----------
    window : Window
    solver : Solver
        The solver of choice.
    reference : callable returning a Solver
        The reference solver, built only when needed.
    guesses : sequence of (name, function returning a Guess)
        Warm start first, then the shifted guess (the prior carried forward); made when their turn comes.
    notes : tuple of str
        Facts about the window for the status.
    real_time : bool
        The solver's iterate at its limit is what is wanted: the first rung that gives finite numbers is the last.
    evaluable : callable returning bool
        Whether the model could be evaluated wherever that was tried. Where not (an FMU that fails), other solvers fail
        too, and take long over it: they are left out.
    rescue : callable returning a Guess, optional
        The guess that is tried instead.

    Returns
    -------
    solution : Solution or None
        None when no rung gave finite numbers: the caller predicts open loop.
    status : Status
    """
    rungs: list[str] = []
    attempts: list[Solution] = []

    def run(name: str, use: Solver, problem: Window, guess: Guess) -> Solution:
        solution = use.solve(problem, guess)
        if not solution.success:
            rungs.append(f"{name} ({use.name}): {solution.message}")
            logger.debug("rung failed: %s", rungs[-1])
        return solution

    for name, make in guesses:
        solution = run(name, solver, window, make())
        if solution.success:
            return solution, _status(Outcome.SOLVED, solution, rungs, notes)
        if real_time and solution.stopped is not None:
            return solution, _status(solution.stopped, solution, (), notes)
        attempts.append(solution)
    if real_time:
        return None, Status(Outcome.PREDICTED, False, rungs=tuple(rungs), notes=notes)
    guess = guesses[-1][1]()
    usable = [a for a in attempts if np.isfinite(a.cost)]
    start = min(usable, key=lambda a: a.feasibility + a.cost * 1e-12).point if usable else guess
    stuck = not evaluable()
    if stuck and rescue is not None:
        solution = run("start-up state", solver, window, rescue())
        if solution.success:
            return solution, _status(Outcome.FALLBACK, solution, rungs, notes)
        attempts.append(solution)
    if not stuck and solver.name != reference().name:
        for point in (start, guess):
            solution = run("reference", reference(), window, point)
            if solution.success:
                return solution, _status(Outcome.FALLBACK, solution, rungs, notes)
            attempts.append(solution)
    feasible = [a for a in attempts if np.isfinite(a.cost) and a.feasibility < 1e-6]
    if feasible:
        best = min(feasible, key=lambda a: a.cost)
        return best, _status(Outcome.ITERATION_LIMIT, best, rungs, notes)
    relaxed = window.relaxed()
    for use in (solver,) if stuck else (solver, reference()):
        solution = run("relaxed bounds", use, relaxed, guess)
        if solution.success:
            violation = bound_violation(window, solution.point, solution.y[:, -1])
            status = _status(Outcome.RELAXED, solution, rungs, notes)
            return solution, replace(status, violation=violation)
    return None, Status(Outcome.PREDICTED, False, rungs=tuple(rungs), notes=notes)


def _status(outcome: Outcome, solution: Solution, rungs: Sequence[str], notes: tuple[str, ...]) -> Status:
    return Status(
        outcome,
        solution.success and outcome is not Outcome.RELAXED,
        solution.iterations,
        solution.optimality,
        solution.feasibility,
        0.0,
        tuple(rungs),
        (*notes, *solution.notes),
        solution.factorizations,
    )
