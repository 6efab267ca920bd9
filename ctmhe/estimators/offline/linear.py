"""Linear estimation over a whole record on plain matrices: the least-squares problem, and the Kalman smoother.

The system is x(k+1) = A x(k) + b(k) + d(k), y(k) = C x(k) + v(k); A and C are one matrix, or one for each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.estimators.offline.blocks import Block, blocks_of, in_parallel
from ctmhe.types import Array, frozen

SETTLED = 1e-12
"""Relative change below which a Riccati recursion of a time-invariant system stands still: it is not repeated."""


@dataclass(frozen=True, eq=False)
class LinearProblem:
    """What is minimised over x(0), ..., x(T): thesis (6.4)-(6.7) and (6.62), for a linear system.

        |x(0) - mean|^2_P + sum over k < T of ( |x(k+1) - A x(k) - b(k)|^2_Q + |y(k) - C x(k)|^2_R )
        + |y(T) - C x(T)|^2_S

    Parameters
    ----------
    A : array (n, n) or (T, n, n)
    C : array (ny, n) or (T + 1, ny, n)
    y : array (T + 1, ny)
        NaN where nothing was measured: that sensor's row is left out (R and S must be diagonal then).
    b : array (T, n), optional
        Known drive, B u(k); zero when left out.
    Q, R : array (n, n), (ny, ny)
        Weights, positive definite.
    S : array (ny, ny), optional
        Terminal weight; `R` when left out (the filtering form), zero for the prediction form.
    P, mean : array (n, n), (n,), optional
        Prior weight and mean; none when left out.

    Raises
    ------
    InputError
        For shapes that do not fit.
    """

    A: Array
    C: Array
    y: Array
    b: Array | None = None
    Q: Any = 1.0
    R: Any = 1.0
    S: Any = None
    P: Any = 0.0
    mean: Any = 0.0

    def __post_init__(self) -> None:
        A, C, y = np.asarray(self.A, float), np.asarray(self.C, float), np.atleast_2d(np.asarray(self.y, float))
        steps, ny, n = len(y) - 1, y.shape[1], A.shape[-1]
        expected = {"A": ((n, n), (steps, n, n)), "C": ((ny, n), (steps + 1, ny, n))}
        for name, value in (("A", A), ("C", C)):
            if value.shape not in expected[name]:
                one, many = expected[name]
                raise InputError(
                    f"LinearProblem: {name} has shape {value.shape}; with y of shape {y.shape} and A of {n} columns it "
                    f"must be {one}, or {many} when it varies"
                )
        b = np.zeros((steps, n)) if self.b is None else np.asarray(self.b, float)
        if b.shape != (steps, n):
            raise InputError(f"LinearProblem: the drive b has shape {b.shape}, expected {(steps, n)}: one row a step")
        S = self.R if self.S is None else self.S
        given = {"Q": (self.Q, n), "R": (self.R, ny), "S": (S, ny), "P": (self.P, n)}
        weights = {name: frozen(_square(weight, size, name)) for name, (weight, size) in given.items()}
        for name, weight in weights.items():
            object.__setattr__(self, name, weight)
        diagonal = all(np.array_equal(weights[name], np.diag(np.diag(weights[name]))) for name in "RS")
        if np.isnan(y).any() and not diagonal:
            raise InputError("LinearProblem: y has gaps (NaN), so R and S must be diagonal; fill or drop those rows")
        mean = np.broadcast_to(np.asarray(self.mean, float), (n,))
        for name, value in (("A", A), ("C", C), ("y", y), ("b", b), ("mean", mean)):
            object.__setattr__(self, name, frozen(value))

    @property
    def steps(self) -> int:
        """T."""
        return len(self.y) - 1

    @property
    def invariant(self) -> bool:
        """Whether all steps are alike: then the Riccati recursions come to rest and need not be repeated."""
        return self.A.ndim == 2 and self.C.ndim == 2 and not np.isnan(self.y).any()

    def part(self, start: int, stop: int, *, prior: bool) -> LinearProblem:
        """Return the problem of the steps start..stop; without the prior unless it is asked for."""
        assert self.b is not None
        A = self.A if self.A.ndim == 2 else self.A[start:stop]
        C = self.C if self.C.ndim == 2 else self.C[start : stop + 1]
        known = {"P": self.P, "mean": self.mean} if prior else {}
        return LinearProblem(A, C, self.y[start : stop + 1], self.b[start:stop], Q=self.Q, R=self.R, S=self.S, **known)


def _square(weight: Any, size: int, name: str) -> Array:
    """Return a weight given as a number, a diagonal or a matrix as a matrix (size, size)."""
    values = np.asarray(weight, float)
    if values.ndim == 0:
        return float(values) * np.eye(size)
    matrix = np.diag(values) if values.ndim == 1 else values
    if matrix.shape != (size, size):
        raise InputError(f"LinearProblem: weight {name} has shape {values.shape}, expected {(size, size)}")
    return matrix


def solve_linear(problem: LinearProblem) -> Array:
    """Return the minimiser x (T + 1, n): the full solution, in O(T) time.

    The normal equations are block tridiagonal; they are solved by a block Cholesky factorisation, whose blocks come to
    rest when the system is time-invariant.

    Raises
    ------
    InputError
        Where the data do not determine the states: the system is not observable over the record, and there is no prior.
    """
    return _solve([problem])[0]


def solve_blocks(problem: LinearProblem, *, block: int, keep: int, workers: int = 1) -> tuple[Array, list[Block]]:
    """Return the approximate estimator (6.77) with Remark 6.12, x (T + 1, n), and its blocks.

    Parameters
    ----------
    problem : LinearProblem
        Its prior counts in the first block only.
    block : int
        N, steps of a truncated problem.
    keep : int
        2 Delta + 1, samples that are kept of it; see `blocks_of`.
    workers : int
        Processes (joblib). Blocks of a time-invariant system share one factorisation and are solved together instead.

    Raises
    ------
    InputError
        For lengths that do not fit, or blocks that do not determine their states: make `block` longer.
    """
    blocks = blocks_of(0, problem.steps, block, keep)
    parts = [problem.part(int(b.start), int(b.stop), prior=b.first) for b in blocks]
    if problem.invariant:
        first, others = parts[:1], parts[1:]
        if not problem.P.any():  # then all are alike
            first, others = [], parts
        solved = [each for group in (first, others) if group for each in _solve(group)]
    else:
        solved = in_parallel([partial(solve_linear, part) for part in parts], workers=workers)
        for answer in solved:
            if isinstance(answer, Exception):
                raise answer
    x, k = np.empty((problem.steps + 1, problem.A.shape[-1])), np.arange(problem.steps + 1)
    for where, values in zip(blocks, solved, strict=True):
        kept = where.keeps(k)
        x[kept] = values[kept[int(where.start) : int(where.stop) + 1]]
    return x, blocks


def _solve(problems: Sequence[LinearProblem]) -> list[Array]:
    """Solve problems that differ in data only: one factorisation, one column of the right-hand side for each."""
    from scipy.linalg import cho_solve  # of SciPy only what is needed, when it is

    problem = problems[0]
    steps, n, invariant = problem.steps, problem.A.shape[-1], problem.invariant
    Q = problem.Q
    right = np.stack([_right_side(each) for each in problems], axis=-1)  # (T + 1, n, problems)
    factors: list[Any] = []
    gains: list[Array] = []  # O_k D_k^-1, with O_k = -Q A_k below the diagonal
    settled = False
    for k in range(steps + 1):
        last = k == steps
        if not settled or last:
            diagonal = _diagonal(problem, k)
            if k:
                below = -Q @ _at(problem.A, k - 1)
                diagonal = diagonal - gains[-1] @ below.T
            factor = _cholesky(diagonal, k, steps)
            if not last:
                gain = cho_solve(factor, -(Q @ _at(problem.A, k)).T, check_finite=False).T
                if invariant and k > 1:
                    settled = bool(np.abs(gain - gains[-1]).max() <= SETTLED * np.abs(gain).max())
        factors.append(factor)  # pyright: ignore[reportPossiblyUnboundVariable]
        if not last:
            gains.append(gain)  # pyright: ignore[reportPossiblyUnboundVariable]
    for k in range(steps):
        right[k + 1] -= gains[k] @ right[k]
    x = np.empty_like(right)
    x[steps] = cho_solve(factors[steps], right[steps], check_finite=False)
    for k in range(steps - 1, -1, -1):  # D_k^-1 (z_k - O_k' x_{k+1})
        x[k] = cho_solve(factors[k], right[k], check_finite=False) - gains[k].T @ x[k + 1]
    return [np.ascontiguousarray(x[:, :, i]).reshape(steps + 1, n) for i in range(len(problems))]


def _at(matrix: Array, k: int) -> Array:
    return matrix if matrix.ndim == 2 else matrix[k]


def _output_weight(problem: LinearProblem, k: int) -> Array:
    """Return R, at the end S, without the sensors that were silent."""
    weight = problem.S if k == problem.steps else problem.R
    known = np.isfinite(problem.y[k])
    return weight if known.all() else weight * np.outer(known, known)


def _diagonal(problem: LinearProblem, k: int) -> Array:
    """Return the block of the normal equations that belongs to x(k)."""
    C, weight = _at(problem.C, k), _output_weight(problem, k)
    block = C.T @ weight @ C
    block = block + (problem.P if k == 0 else problem.Q)
    if k < problem.steps:
        A = _at(problem.A, k)
        block = block + A.T @ problem.Q @ A
    return block


def _right_side(problem: LinearProblem) -> Array:
    """Return the right-hand side (T + 1, n) of the normal equations."""
    steps = problem.steps
    y, Q, b = np.nan_to_num(problem.y), problem.Q, problem.b
    assert b is not None
    if problem.C.ndim == 2 and np.isfinite(problem.y).all():
        right = y @ problem.R @ problem.C
        right[steps] = y[steps] @ problem.S @ problem.C
    else:
        right = np.stack([y[k] @ _output_weight(problem, k) @ _at(problem.C, k) for k in range(steps + 1)])
    pushed = b @ Q
    back = pushed @ problem.A if problem.A.ndim == 2 else np.einsum("ki,kij->kj", pushed, problem.A)
    right[:-1] -= back
    right[1:] += pushed
    right[0] += problem.P @ problem.mean
    return right


def _cholesky(matrix: Array, k: int, steps: int) -> Any:
    from scipy.linalg import cho_factor

    try:
        return cho_factor(matrix)
    except np.linalg.LinAlgError:
        raise InputError(
            f"the record does not determine the state at step {k} of {steps}: the system is not observable from these "
            "outputs over this stretch. Lengthen the block, or give a prior weight P"
        ) from None


@dataclass(frozen=True, eq=False)
class Smoothed:
    """What a fixed-interval smoother returns; all over k = 0, ..., T.

    Attributes
    ----------
    filtered : array (T + 1, n), filtered_variance : array (T + 1, n)
        The Kalman filter's estimate from y(0..k), and the diagonal of its covariance.
    x : array (T + 1, n), variance : array (T + 1, n)
        The smoother's, from all of y.
    """

    filtered: Array
    filtered_variance: Array
    x: Array
    variance: Array


def rauch_tung_striebel(problem: LinearProblem, *, smooth: bool = True) -> Smoothed:
    """Return the Kalman filter's and the Rauch-Tung-Striebel smoother's estimates, in O(T).

    The weights are inverse covariances: of x(0) P, of d Q, of v R; the last measurement counts with R as well, so S is
    not used. The smoothed states are the minimiser of `problem` with S = R, found by recursions.

    Parameters
    ----------
    problem : LinearProblem
    smooth : bool
        Without: the filter alone, whose estimates then stand for the smoothed ones as well.

    Raises
    ------
    InputError
        Without a prior: the recursion starts from one; `solve_linear` needs none.
    """
    steps, n = problem.steps, problem.A.shape[-1]
    if np.linalg.matrix_rank(problem.P) < n:
        raise InputError(
            "rauch_tung_striebel: the prior weight P must be positive definite; solve_linear needs no prior"
        )
    noise, measured = np.linalg.inv(problem.Q), np.linalg.inv(problem.R)
    predicted: list[Array] = [np.linalg.inv(problem.P)]
    updated: list[Array] = []
    filtered, ahead = np.empty((steps + 1, n)), np.empty((steps + 1, n))
    ahead[0], settled, gain = problem.mean, False, np.empty(0)
    assert problem.b is not None
    for k in range(steps + 1):
        C, y = _at(problem.C, k), problem.y[k]
        known = np.isfinite(y)
        if not known.all():
            C, y = C[known], y[known]
        if not settled:
            P = predicted[k]
            innovation = C @ P @ C.T + measured[np.ix_(known, known)]
            gain = np.linalg.solve(innovation, C @ P).T if len(y) else np.empty((n, 0))
            remaining = np.eye(n) - gain @ C
            updated.append(remaining @ P @ remaining.T + gain @ measured[np.ix_(known, known)] @ gain.T)
        else:
            updated.append(updated[-1])
        filtered[k] = ahead[k] + gain @ (y - C @ ahead[k])
        if k < steps:
            A = _at(problem.A, k)
            ahead[k + 1] = A @ filtered[k] + problem.b[k]
            following = predicted[-1] if settled else A @ updated[k] @ A.T + noise
            settled = settled or (
                problem.invariant and bool(np.abs(following - predicted[k]).max() <= SETTLED * np.abs(following).max())
            )
            predicted.append(following)
    filtered_variance = np.array([np.diagonal(P) for P in updated])
    if not smooth:
        filtered, filtered_variance = frozen(filtered), frozen(filtered_variance)
        return Smoothed(filtered, filtered_variance, filtered, filtered_variance)
    x, variance = filtered.copy(), np.empty((steps + 1, n))
    covariance, known_gain, back = updated[steps], None, np.empty(0)
    variance[steps] = np.diagonal(covariance)
    for k in range(steps - 1, -1, -1):
        if known_gain is not updated[k]:
            back = np.linalg.solve(predicted[k + 1], _at(problem.A, k) @ updated[k]).T
            known_gain = updated[k] if problem.invariant else None
            still = False
        x[k] = filtered[k] + back @ (x[k + 1] - ahead[k + 1])
        if not still:  # pyright: ignore[reportPossiblyUnboundVariable]
            smoothed = updated[k] + back @ (covariance - predicted[k + 1]) @ back.T
            still = known_gain is not None and bool(
                np.abs(smoothed - covariance).max() <= SETTLED * np.abs(smoothed).max()
            )
            covariance = smoothed
        variance[k] = np.diagonal(covariance)
    return Smoothed(frozen(filtered), frozen(filtered_variance), frozen(x), frozen(variance))
