"""Polytopes as models, and the examples of paper 003, derived a second time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.models import ContinuousModel, polytope
from ctmhe.models.library import drifting_sine, sine_drift, sine_polytope, unknown_linear, unknown_linear_matrices


def step(model, x, w=(0.0, 0.0), p=None, u=()):
    """One evaluation of dynamics and output."""
    p = model.p_start if p is None else p
    parts = (model.dynamics(0, x, u, w, p), model.output(0, x, u, w, p))
    return [np.asarray(part).reshape(-1) for part in parts]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 4), st.booleans())
def test_a_polytope_mixes_its_vertices(seed, q, discrete):
    """Written out as a sum over vertices, in numpy, for random weights; inputs and disturbances enter alike in all."""
    rng = np.random.default_rng(seed)
    A, C, B = rng.normal(size=(q, 2, 2)), rng.normal(size=(q, 1, 2)), rng.normal(size=(2, 1))
    model = polytope(list(A), list(C), B=B, step=0.5 if discrete else None)
    alpha, x, w, u = rng.dirichlet(np.ones(q)), rng.normal(size=2), rng.normal(size=2), rng.normal(size=1)
    f, h = step(model, x, w, alpha if q > 1 else [], u)
    np.testing.assert_allclose(f, sum(alpha[i] * A[i] @ x for i in range(q)) + B @ u + w, atol=1e-12)
    np.testing.assert_allclose(h, sum(alpha[i] * C[i] @ x for i in range(q)), atol=1e-12)
    assert isinstance(model, ContinuousModel) and (model.step == 0.5 if discrete else model.step is None)
    assert len(model.p) == (q if q > 1 else 0)


def test_the_unknown_linear_system_is_in_observer_form():
    """(74)-(75) entry by entry: a_1, a_2, c_1, c_2 of the system, and eigenvalues by the quadratic formula."""
    A, C = unknown_linear_matrices()
    s = (0.22, 0.76, 0.02)
    a1 = s[0] * 0.72 - s[1] * 0.59 - s[2] * 0.35
    a2 = s[0] * 0.28 + s[1] * 1.57 + s[2] * 1.26
    np.testing.assert_allclose(A, [[0, a1], [1, a2]], atol=1e-12)
    np.testing.assert_allclose(C, [[-0.22 * 1.46 - 0.76 * 4.84 - 0.02 * 0.09, -0.22 * 1.29 - 0.76 * 2.9 - 0.02 * 0.03]])
    roots = (a2 + np.array([1, -1]) * np.sqrt(a2**2 + 4 * a1)) / 2
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(A)), np.sort(roots))
    f, h = step(unknown_linear(), [1.0, 2.0], p=s)
    np.testing.assert_allclose(f, A @ [1.0, 2.0])
    np.testing.assert_allclose(h, C @ [1.0, 2.0])


def test_the_drifting_sine_and_what_is_printed_beside_it():
    """(76) by hand; (77) drives p1 to zero as printed; (78) holds the system for p1 = 1 and small x2 only."""
    f, h = step(drifting_sine(), [0.4, -0.6], p=[0.7, 0.05])
    np.testing.assert_allclose(f, [-0.6, 0.28 + np.sin(-0.03)])
    np.testing.assert_allclose(h, [-0.1])
    p1 = sine_drift(1.0, 40)
    assert p1[1] == pytest.approx(0.01 * np.sin(np.pi / 8)) and np.abs(p1[5:]).max() < 1e-10
    model = sine_polytope()
    A1, A2, A3 = np.array([[0, 1.3], [1, -1.52]]), np.array([[0, -2.44], [1, 0.66]]), np.array([[0, 1.31], [1, 2.81]])
    rows = np.array([[A[0, 1] for A in (A1, A2, A3)], [A[1, 1] for A in (A1, A2, A3)], [1, 1, 1]])
    inside = np.linalg.solve(rows, [1.0, 0.05, 1.0])  # p1 = 1: [0 1; 1 0.05]
    assert inside.min() > 0
    np.testing.assert_allclose(step(model, [0.3, 0.2], p=inside)[0], [0.2, 0.3 + 0.05 * 0.2], atol=1e-12)
    assert all(A[1, 0] == 1 for A in (A1, A2, A3))  # every mixture has a one where the system has p1
