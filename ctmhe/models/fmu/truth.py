"""Whether an evaluator says what the FMU says: values against fmpy, Jacobians against finite differences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctmhe.errors import FmuDerivativeError, FmuError, FmuParameterError, FmuUnsupportedError
from ctmhe.models.fmu.choice import Choice, magnitude
from ctmhe.models.fmu.evaluators import Evaluator
from ctmhe.models.fmu.reference import Reference
from ctmhe.types import Array

VALUE_TOLERANCE = 1e-6  # loose enough for FMUs that solve algebraic loops by iteration
SLOPE_TOLERANCE = 1e-4
ROUND_OFF = 1e-12  # of a derivative that is zero, against the largest of its row
# Relative steps of differences. The first suits exact arithmetic; the others see through the noise of algebraic loops
# and of integrators inside a co-simulation.
REACHES = (6e-6, 6e-5, 6e-4, 6e-3)


class Point(NamedTuple):
    """Arguments of an evaluation without w."""

    t: float
    x: Array
    u: Array
    p: Array


@dataclass(frozen=True)
class Findings:
    """What was found out about an FMU.

    Attributes
    ----------
    configuration : dict
        With what has to be done differently for this FMU.
    warnings : tuple of str
    usable : tuple of Point
        Where it was evaluated.
    """

    configuration: dict[str, Any]
    warnings: tuple[str, ...]
    usable: tuple[Point, ...]


class Examination:
    """Compares evaluators of one choice with the FMU.

    Parameters
    ----------
    choice : Choice
    reference : Reference
    configuration : dict
        Fields of `worker.Configuration`.
    start : Point
    seconds : float or None
        As for `Evaluators`.
    thorough : bool
        At three points instead of one.
    """

    def __init__(
        self,
        choice: Choice,
        reference: Reference,
        configuration: dict[str, Any],
        start: Point,
        *,
        seconds: float | None,
        thorough: bool,
    ):
        self.choice, self.name, self.reference = choice, choice.about.name, reference
        driven = [v.name for v in choice.driven]
        # every driven input is disturbed, and nothing else: then the columns of J are x, driven inputs, p
        self._everything = {
            "nw": len(driven),
            "input_w": list(range(len(driven))),
            "w_state": [-1] * len(driven),
            "w_output": [-1] * len(driven),
        }
        self.configuration, self.seconds = dict(configuration), seconds
        states = [v.name for v in choice.states]
        self.rows = [f"der({n})" if choice.exchange else f"next {n}" for n in states]
        self.rows += [v.name for v in choice.outputs]
        self.columns = {"x": states, "v": driven, "p": [v.name for v in choice.parameters]}
        ends = np.cumsum([len(names) for names in self.columns.values()]).tolist()
        self.parts = dict(zip(self.columns, map(slice, [0, *ends[:-1]], ends), strict=True))
        self.none = np.zeros(len(driven))
        self.points = list(_points(choice, start)) if thorough else [start]
        self.warnings: list[str] = []

    def run(self) -> Findings:
        """Do all; raises what the estimator must not be built with.

        Raises
        ------
        FmuDerivativeError, FmuParameterError, FmuUnsupportedError
            Naming the variable.
        """
        usable = self.values()
        self.derivatives(usable)
        self.dependencies(usable)
        return Findings(self.configuration, tuple(self.warnings), tuple(usable))

    # ---- values -----------------------------------------------------------------------------------------------------

    def values(self) -> list[Point]:
        """Compare values; find out how parameters are set. Returns the points where the FMU can be evaluated."""
        usable: list[Point] = []
        truth: list[Array] = []
        for number, point in enumerate(self.points):
            try:
                value = np.concatenate(self.reference.evaluate(*point))
            except FmuError as error:
                if number == 0:
                    raise FmuDerivativeError(
                        f"{self.name} cannot be evaluated at its start values: {error}. Give others with start={{...}}"
                    ) from error
                continue
            if np.isfinite(value).all():
                usable.append(point)
                truth.append(value)
            elif number == 0:
                bad = self.rows[int(np.flatnonzero(~np.isfinite(value))[0])]
                raise FmuDerivativeError(
                    f"{self.name}: {bad!r} is not finite at the start values; give others with start={{...}}"
                )
        # there and back: what an evaluation leaves behind must not matter
        order = [*range(len(usable)), 0]
        start = self.points[0].p
        held = [usable[i]._replace(p=start) for i in order]
        moved = [usable[i] for i in order]
        expected = [truth[i] for i in order]
        expected_held = [np.concatenate(self.reference.evaluate(*point)) for point in held] if len(start) else expected
        modes = self._modes()
        wrong = [self._mismatch(self._with_mode(mode), held, expected_held) for mode in modes]
        if all(wrong) and len(start):  # would it do without parameters?
            without = self._mismatch(self.configuration | {"np": 0}, held, expected_held)
            wrong = [without] if without else []
        if all(wrong) and wrong:
            raise FmuDerivativeError(
                f"{self.name}: {wrong[0]}, so it cannot be used in an estimator. Its values may be stale after a set, "
                "or depend on what was evaluated before: export the FMU with a newer tool, or use it as the plant "
                "(FmuPlant)"
            )
        if len(start):
            self._find_parameter_mode(moved)
        if not self.choice.exchange:
            self._same_at_any_time(usable[0])
        return usable

    def _modes(self) -> tuple[int, ...]:
        """Return how parameters may be set: as they come, or in event mode."""
        return (0, 1) if self.choice.exchange and len(self.points[0].p) else (0,)

    def _find_parameter_mode(self, points: list[Point]) -> None:
        start = self.points[0].p
        points = points if len(points) > 2 else [p._replace(p=1.05 * p.p + (p.p == 0)) for p in points]

        def mismatches(moved: list[Point]) -> list[str]:
            truth = [np.concatenate(self.reference.evaluate(*point)) for point in moved]
            return [self._mismatch(self._with_mode(mode), moved, truth) for mode in self._modes()]

        found = mismatches(points)
        if all(found):
            culprit = self.columns["p"][0]  # unless one of them fails alone
            for j, name in enumerate(self.columns["p"]):
                alone = mismatches([p._replace(p=np.where(np.arange(len(start)) == j, p.p, start)) for p in points])
                if all(alone):
                    culprit, found = name, alone
                    break
            raise FmuParameterError(
                f"{self.name}: parameter {culprit!r} cannot be changed while the FMU runs ({found[0]}), so it cannot "
                "be estimated; leave it out of parameters=, or export the FMU with a tool that lets tunable parameters "
                "be set"
            )
        self.configuration["p_in_event_mode"] = self._modes()[found.index("")]

    def _with_mode(self, mode: int) -> dict[str, Any]:
        return self.configuration | {"p_in_event_mode": mode}

    def _mismatch(self, configuration: dict[str, Any], points: Sequence[Point], expected: Sequence[Array]) -> str:
        """Return what differs first, or nothing."""
        evaluator = self._evaluator(configuration | {"directional": 0})
        try:
            for point, own in zip(points, expected, strict=True):
                try:
                    t, x, u, p = point
                    ours = np.concatenate(evaluator.evaluate(t, x, u, self.none, p, jacobian=False)[:2])
                except FloatingPointError as error:
                    return str(error)
                wrong = ~(np.abs(own - ours) <= VALUE_TOLERANCE * np.maximum(np.abs(own), VALUE_TOLERANCE))
                if wrong.any():
                    i = int(np.flatnonzero(wrong)[0])
                    return f"{self.rows[i]!r} evaluates to {ours[i]:.10g}, in a fresh instance to {own[i]:.10g}"
        finally:
            evaluator.close()
        return ""

    def _evaluator(self, configuration: dict[str, Any]) -> Evaluator:
        return Evaluator(configuration | self._everything, [], self.seconds)

    def _same_at_any_time(self, point: Point) -> None:
        here = self.reference.evaluate(*point)[0]
        later = self.reference.evaluate(*point._replace(t=point.t + 10 * (self.choice.step or 1.0)))[0]
        size = np.array([v.nominal for v in self.choice.states])
        off = np.abs(later - here) > 1e-4 * np.maximum(size, np.abs(here))
        if off.any():
            name = self.columns["x"][int(np.flatnonzero(off)[0])]
            raise FmuUnsupportedError(
                f"{self.name}: a step from the same state at another time ends at another {name!r}; as a step map, a "
                "co-simulation must not depend on time: make time an input, or export it as model exchange"
            )

    # ---- derivatives ------------------------------------------------------------------------------------------------

    def derivatives(self, points: Sequence[Point]) -> None:
        """Compare the Jacobians of an evaluator with differences of its values; switch to differences where wrong."""
        slopes = [self._slopes(point) for point in points]
        if not self.configuration["directional"]:
            self._choose_reach(slopes)
            wrong = self._wrong(points, slopes)
        else:
            try:
                wrong = self._wrong(points, slopes)
            except FloatingPointError as error:
                wrong = self._with_fewer(points, slopes, str(error))
        if wrong and self.configuration["directional"]:
            said = "; ".join(
                f"d {row} / d {column} is {has:.6g} and not {should:.6g}" for row, column, _, has, should in wrong[:3]
            )
            self.warnings.append(
                f"{self.name}: its directional derivatives are wrong: {said}{'; ...' if len(wrong) > 3 else ''}. "
                "Derivatives with respect to "
                f"{', '.join(dict.fromkeys(column for _, column, *_ in wrong))} are finite differences instead"
            )
            for _, _, flat, *_ in wrong:
                self.configuration["differenced"][flat] = 1
            self._choose_reach(slopes)
            wrong = self._wrong(points, slopes)
        if wrong:
            row, column, _, has, should = wrong[0]
            raise FmuDerivativeError(
                f"{self.name}: the derivative of {row!r} with respect to {column!r} is {has:.6g}, but finite "
                f"differences give {should:.6g}; an estimator would go wrong. {row!r} may be rough or "
                f"jump in {column!r}: export the FMU with directional derivatives, or with tighter "
                "tolerances of its own solvers"
            )

    def _with_fewer(self, points: Sequence[Point], slopes: Sequence[Any], reason: str) -> list[Any]:
        """Take differences where the FMU refuses directional derivatives; return what is wrong then.

        FMI 2 grants them by states and continuous inputs only, so that parameters are the first to be left out.
        """
        self._choose_reach(slopes)
        taken: list[str] = []
        for key, group in {"p": "parameters", "v": "inputs"}.items():
            part = self.parts[key]
            if part.start == part.stop:
                continue
            self.configuration["differenced"][part] = [1] * (part.stop - part.start)
            taken.append(group)
            try:
                wrong = self._wrong(points, slopes)
            except FloatingPointError:
                continue
            self.warnings.append(
                f"{self.name}: its directional derivatives by {' and '.join(taken)} fail ({reason}); these are finite "
                "differences"
            )
            return wrong
        self.warnings.append(
            f"{self.name}: its directional derivatives fail ({reason}); derivatives are finite differences"
        )
        self.configuration["directional"] = 0
        return self._wrong(points, slopes)

    def _slopes(self, point: Point) -> dict[float, tuple[dict[str, Array], dict[str, Array]]]:
        """Return, for each reach, the one-sided slopes (backward, forward) (rows, n) by x, driven inputs and p."""
        evaluator = self._evaluator(self.configuration | {"directional": 0})
        at = {"x": point.x, "v": self.none, "p": point.p}

        def value(**moved: Array) -> Array:
            x, v, p = (at | moved).values()
            try:
                return np.concatenate(evaluator.evaluate(point.t, x, point.u, v, p, jacobian=False)[:2])
            except FloatingPointError:
                return np.full(len(self.rows), np.nan)

        try:
            here = value()
            result = {}
            for reach in REACHES:
                sides: tuple[dict[str, Array], dict[str, Array]] = ({}, {})
                for key, sizes in self._sizes().items():
                    base = at[key]
                    for sign, side in zip((-1.0, 1.0), sides, strict=True):
                        columns = []
                        for j, size in enumerate(sizes):
                            step = np.zeros(len(base))
                            step[j] = sign * reach * max(size, abs(base[j]))
                            columns.append((value(**{key: base + step}) - here) / step[j])
                        side[key] = np.array(columns).reshape(-1, len(here)).T
                result[reach] = sides
            return result
        finally:
            evaluator.close()

    def _sizes(self) -> dict[str, list[float]]:
        choice = self.choice
        return {
            "x": [v.nominal for v in choice.states],
            "v": [magnitude(v) for v in choice.driven],
            "p": [magnitude(v) for v in choice.parameters],
        }

    def _choose_reach(self, slopes: Sequence[Any]) -> None:
        """Take the step of differences at which forward and backward slopes agree best, per their size."""

        def roughness(reach: float) -> float:
            total = 0.0
            for sides in slopes:
                for key in self.parts:
                    backward, forward = (side[key] for side in sides[reach])
                    # of central differences the error is of second order: that of the next larger step tells it
                    larger = sides[REACHES[min(REACHES.index(reach) + 1, len(REACHES) - 1)]]
                    central, wider = (backward + forward) / 2, (larger[0][key] + larger[1][key]) / 2
                    scale = np.abs(central).max(axis=0, initial=1e-300) if central.size else 1.0
                    total = max(total, float(np.nan_to_num(np.abs(central - wider) / scale, nan=1e3).max(initial=0.0)))
            return total

        self.configuration["reach"] = min(REACHES[:-1], key=roughness)

    def _wrong(self, points: Sequence[Point], slopes: Sequence[Any]) -> list[tuple[str, str, int, float, float]]:
        """Return the entries that lie outside the slopes at every reach: row, column, flat column, has, should be."""
        evaluator = self._evaluator(self.configuration)
        wrong = {}
        try:
            for point, sides in zip(points, slopes, strict=True):
                J = evaluator.evaluate(point.t, point.x, point.u, self.none, point.p)[2]
                for key, part in self.parts.items():
                    block = J[:, part]
                    off = np.ones(block.shape, dtype=bool)
                    for backward, forward in (side_pair(sides[reach], key) for reach in REACHES):
                        # at a kink any slope between the two sides is right
                        low, high = np.minimum(backward, forward), np.maximum(backward, forward)
                        scale = np.maximum(np.abs(low), np.abs(high)).max(axis=0, initial=0.0)
                        near = SLOPE_TOLERANCE * scale + 1e-12
                        off &= ~((block >= low - near) & (block <= high + near)) & np.isfinite(low + high)
                    backward, forward = side_pair(sides[REACHES[0]], key)
                    for i, j in np.argwhere(off):
                        flat = part.start + int(j)
                        should = (backward[i, j] + forward[i, j]) / 2
                        wrong.setdefault((i, flat), (self.rows[i], self.columns[key][j], flat, block[i, j], should))
        finally:
            evaluator.close()
        return list(wrong.values())

    # ---- dependencies -----------------------------------------------------------------------------------------------

    def dependencies(self, points: Sequence[Point]) -> None:
        """Compare what the FMU says its derivatives depend on with where their Jacobian is not zero."""
        if not self.choice.exchange:
            return
        declared = self.choice.about.dependencies
        evaluator = self._evaluator(self.configuration)
        try:
            Js = [evaluator.evaluate(t, x, u, self.none, p)[2] for t, x, u, p in points]
        finally:
            evaluator.close()
        names = [v.name for v in self.choice.about.derivatives] + [v.name for v in self.choice.outputs]
        missing, silent = [], []
        for i, name in enumerate(names):
            known = declared.get(name)
            if known is None:
                if name in declared:
                    silent.append(name)
                continue
            about = self.choice.about.variables
            same = {about[n].reference for n in known if n in about}  # whichever of its names is listed
            for key, part in self.parts.items():
                if key == "p" and self.choice.about.major == 2:  # which counts them during initialization only
                    continue
                for n, j in zip(self.columns[key], range(part.start, part.stop), strict=True):
                    if about[n].reference not in same and any(
                        abs(J[i, j]) > ROUND_OFF * np.abs(J[i]).max() for J in Js
                    ):
                        missing.append(f"{name} on {n}")
        if missing:
            self.warnings.append(
                f"{self.name}: its `dependencies` are wrong; they leave out: {', '.join(missing)}. All derivatives are "
                "taken here, so that estimates are right; other tools may go wrong"
            )
        if silent:
            self.warnings.append(
                f"{self.name}: lists no `dependencies` of {', '.join(silent)}; all derivatives are taken"
            )


def side_pair(sides: tuple[dict[str, Array], dict[str, Array]], key: str) -> tuple[Array, Array]:
    """Return the backward and forward slopes by x, u or p."""
    return sides[0][key], sides[1][key]


def _points(choice: Choice, start: Point) -> Iterator[Point]:
    """Yield the start, then two points around it inside the variables' limits."""
    random = np.random.default_rng(20)
    yield start
    for t in (0.5, 1.5):
        parts = []
        for variables, at in ((choice.states, start.x), (choice.inputs, start.u), (choice.parameters, start.p)):
            size = np.where(at != 0, np.abs(at), [0.1 * v.nominal for v in variables])
            moved = at + random.uniform(0.01, 0.1, len(at)) * size
            lower = [-np.inf if v.minimum is None else v.minimum for v in variables]
            upper = [np.inf if v.maximum is None else v.maximum for v in variables]
            parts.append(np.clip(moved, lower, upper))
        yield Point(start.t + t if choice.exchange else start.t, *parts)


def same_when_mapped(name: str, function: ca.Function, points: Sequence[Point], rows: Sequence[str], nw: int) -> None:
    """Compare the Jacobian of three mapped Euler stages, as a solver takes it, with the one of each stage."""
    stages = [points[i % len(points)] for i in range(3)]
    sizes = [function.size1_in(i) for i in range(5)]
    mapped = [ca.MX.sym(key, size, 3) for key, size in zip("txuwp", sizes, strict=True)]
    chain = mapped[1] + 0.01 * function.map(3)(*mapped)
    derivative = ca.Function("J", mapped, [ca.jacobian(ca.vec(chain), ca.vec(mapped[i])) for i in (1, 4)])
    arguments = [[s.t, s.x, s.u, np.zeros(nw), s.p] for s in stages]
    together = [
        np.asarray(ca.DM(v)) for v in derivative.call([np.column_stack(c) for c in zip(*arguments, strict=True)])
    ]
    nx = sizes[1]
    for k, given in enumerate(arguments):
        blocks = [np.asarray(ca.DM(v)) for v in function.jacobian().call([*given, function.call(given)[0]])]
        for value, block, width, identity in (
            (together[0], blocks[1], nx, np.eye(nx)),
            (together[1], blocks[4], sizes[4], 0.0),
        ):
            expected = np.zeros((nx, 3 * width))
            expected[:, k * width : (k + 1) * width] = 0.01 * block + identity
            error = np.abs(value[k * nx : (k + 1) * nx] - expected)
            wrong = ~(error <= 1e-9 * (1.0 + np.abs(expected)))
            if wrong.any():
                row = rows[int(np.argwhere(wrong)[0, 0])]
                raise FmuDerivativeError(
                    f"{name}: CasADi's derivative of {row!r} changes when stages are evaluated together, so an "
                    "estimator would go wrong; this is a defect of this CasADi version: use another"
                )
