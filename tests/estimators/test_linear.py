"""Linear problems over a record: the structured solution, the smoother, and blocks, held to the plain least squares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.estimators.offline.blocks import blocks_of
from ctmhe.estimators.offline.linear import LinearProblem, rauch_tung_striebel, solve_blocks, solve_linear
from ctmhe.models.library import random_stable


def problem(seed: int, *, n: int = 4, outputs: int = 2, steps: int = 30, prior: bool = True) -> LinearProblem:
    """Return a random problem with unequal weights."""
    rng = np.random.default_rng(seed)
    A, _, C = random_stable(n, 1, outputs, seed=rng)
    y, b = rng.normal(size=(steps + 1, outputs)), rng.normal(size=(steps, n))
    known = {"P": 0.5 * np.eye(n), "mean": rng.normal(size=n)} if prior else {}
    return LinearProblem(A, C, y, b, Q=2.0, R=np.linspace(1.0, 3.0, outputs), **known)


def least_squares(problem: LinearProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimiser and the diagonal of the inverse normal matrix, dense."""
    steps, n = problem.steps, problem.A.shape[-1]
    rows, right = [], []

    def add(places, matrices, value, weight):
        row = np.zeros((len(value), (steps + 1) * n))
        for k, M in zip(places, matrices, strict=True):
            row[:, k * n : (k + 1) * n] = M
        root = np.linalg.cholesky(weight).T
        rows.append(root @ row)
        right.append(root @ value)

    if problem.P.any():
        add([0], [np.eye(n)], problem.mean, problem.P)
    for k in range(steps + 1):
        C = problem.C if problem.C.ndim == 2 else problem.C[k]
        known = np.isfinite(problem.y[k])
        weight = problem.S if k == steps else problem.R
        if known.any():
            add([k], [C[known]], problem.y[k, known], weight[np.ix_(known, known)])
    for k in range(steps):
        A = problem.A if problem.A.ndim == 2 else problem.A[k]
        add([k, k + 1], [-A, np.eye(n)], problem.b[k], problem.Q)
    M, z = np.vstack(rows), np.concatenate(right)
    x = np.linalg.lstsq(M, z, rcond=None)[0].reshape(steps + 1, n)
    return x, np.diagonal(np.linalg.inv(M.T @ M)).reshape(steps + 1, n)


@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize("varying", [True, False])
def test_the_structured_solution_is_the_least_squares_solution(prior, varying):
    """Block elimination solves the same problem as a dense factorisation, with and without prior, varying or not."""
    given_problem = problem(0, prior=prior)
    if varying:
        rng = np.random.default_rng(1)
        given_problem = replace(
            given_problem,
            A=given_problem.A + 0.1 * rng.normal(size=(30, 4, 4)),
            C=given_problem.C + 0.1 * rng.normal(size=(31, 2, 4)),
        )
    np.testing.assert_allclose(solve_linear(given_problem), least_squares(given_problem)[0], atol=1e-9)


@given(seed=st.integers(0, 10**6), gaps=st.floats(0.0, 0.6))
@settings(max_examples=20, deadline=None)
def test_the_smoother_equals_the_full_problem(seed, gaps):
    """With prior and weights as inverse covariances, Rauch-Tung-Striebel gives minimiser and variances, gaps or not."""
    full = problem(seed)
    lost = np.random.default_rng(seed).uniform(size=full.y.shape) < gaps
    full = replace(full, y=np.where(lost, np.nan, full.y))
    smoothed = rauch_tung_striebel(full)
    x, variance = least_squares(full)
    np.testing.assert_allclose(smoothed.x, solve_linear(full), atol=1e-9)
    np.testing.assert_allclose(smoothed.x, x, atol=1e-8)
    np.testing.assert_allclose(smoothed.variance, variance, rtol=1e-7)


def test_the_filter_knows_the_past_only():
    """The filtered estimate at k is the last state of the problem that ends there."""
    full = problem(3)
    smoothed = rauch_tung_striebel(full)
    for k in (1, 7, 30):
        part = full.part(0, k, prior=True)
        np.testing.assert_allclose(smoothed.filtered[k], solve_linear(part)[-1], atol=1e-9)
    assert np.all(smoothed.variance <= smoothed.filtered_variance * (1 + 1e-9))


def test_a_long_record_comes_to_rest_and_stays_exact():
    """Recursions that stop where they stand still give what they give when they are repeated at every step."""
    long = problem(5, steps=400)
    repeated = replace(long, A=np.repeat(long.A[None], 400, axis=0))
    np.testing.assert_allclose(solve_linear(long), solve_linear(repeated), atol=1e-9)
    for name in ("x", "variance", "filtered", "filtered_variance"):
        np.testing.assert_allclose(
            getattr(rauch_tung_striebel(long), name), getattr(rauch_tung_striebel(repeated), name), atol=1e-9
        )


@pytest.mark.parametrize("prior", [True, False])
def test_one_block_is_the_full_solution(prior):
    """The approximate estimator with one block is the full solution."""
    full = problem(7, prior=prior)
    x, blocks = solve_blocks(full, block=30, keep=30)
    assert len(blocks) == 1
    np.testing.assert_array_equal(x, solve_linear(full))


def test_blocks_approach_the_full_solution_exponentially():
    """Doubling what is dropped at both ends of a block about squares the error: both arcs decay at a rate."""
    full = problem(11, n=6, outputs=2, steps=300, prior=False)
    exact = solve_linear(full)
    drop = np.array([4, 8, 12, 16])
    errors = np.array([np.abs(solve_blocks(full, block=2 * d + 20, keep=21)[0] - exact).max() for d in drop])
    rate = np.exp(np.diff(np.log(errors)) / np.diff(drop))
    assert (errors[1:] < errors[:-1]).all() and errors[-1] < 1e-2 * errors[0]
    assert rate.max() < 0.9


def test_varying_systems_are_solved_block_by_block():
    """A time-varying system in blocks equals the invariant one when it does not vary."""
    full = problem(13, steps=120)
    same = replace(full, A=np.repeat(full.A[None], 120, axis=0))
    np.testing.assert_allclose(
        solve_blocks(full, block=40, keep=21)[0], solve_blocks(same, block=40, keep=21)[0], atol=1e-9
    )


def test_the_number_of_blocks_is_that_of_the_remark():
    """T = N + (k + 1)(2 Delta + 1) takes k + 2 blocks (Remark 6.12), and each keeps its middle."""
    blocks = blocks_of(0, 4803, 150, 141)
    assert len(blocks) == 34
    nodes = np.arange(4804)
    kept = np.array([block.keeps(nodes).sum() for block in blocks])
    assert kept.sum() == 4804 and (kept[1:-1] == 141).all()
    middle = nodes[blocks[5].keeps(nodes)] - blocks[5].start
    assert (middle[0], middle[-1]) == (75 - 70, 75 + 70)


@given(length=st.floats(1.0, 1e4), share=st.floats(0.01, 1.5), part=st.floats(0.01, 1.0), start=st.floats(-1e3, 1e3))
@settings(max_examples=100, deadline=None)
def test_blocks_cover_a_record_once(length, share, part, start):
    """Whatever the lengths, every instant is kept from exactly one block, which sees it."""
    blocks = blocks_of(start, start + length, share * length, part * share * length)
    times = np.linspace(start, start + length, 301)
    times[-1] = start + length
    kept = np.array([block.keeps(times) for block in blocks])
    assert (kept.sum(axis=0) == 1).all()
    for block, mine in zip(blocks, kept, strict=True):
        assert ((times[mine] >= block.start - 1e-6) & (times[mine] <= block.stop + 1e-6)).all()


def test_what_does_not_fit_is_named():
    """Shapes, missing observability, missing priors and lengths are named in the error."""
    full = problem(0)
    with pytest.raises(InputError, match="C has shape"):
        replace(full, C=np.eye(3))
    with pytest.raises(InputError, match="drive b"):
        replace(full, b=np.zeros((3, 4)))
    with pytest.raises(InputError, match="weight Q"):
        replace(full, Q=np.eye(3))
    with pytest.raises(InputError, match="diagonal"):
        replace(full, y=np.full_like(full.y, np.nan), R=np.array([[2.0, 1.0], [1.0, 2.0]]))
    blind = LinearProblem(np.diag([1.0, 0.0]), np.array([[1.0, 0.0]]), np.zeros((5, 1)))
    with pytest.raises(InputError, match="not observable"):
        solve_linear(blind)
    with pytest.raises(InputError, match="needs no"):
        rauch_tung_striebel(blind)
    with pytest.raises(InputError, match="keep at most the block"):
        solve_blocks(full, block=10, keep=11)
    with pytest.raises(InputError, match="block must be"):
        solve_blocks(full, block=0, keep=1)
