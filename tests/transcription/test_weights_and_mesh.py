"""Meshes and weights, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from ctmhe.transcription.grid import build_mesh, discounted_length
from ctmhe.transcription.weights import observed_part, square_root, weight_matrix


@given(
    st.floats(-50, 50),
    st.floats(1e-3, 5.0),
    st.floats(0.01, 1.0),
    st.lists(st.floats(-60, 60), max_size=8),
)
def test_slots_tile_the_window_and_never_straddle_a_cell_or_a_sample(start, length, interval, instants):
    """Lengths add up; every cell edge and every sample inside is an edge; one cell, one number."""
    end = start + length
    mesh = build_mesh(start, end, interval, np.array(instants), sample_at_start=False)
    assert mesh.t[0] == start and mesh.t[-1] == end
    assert mesh.h.sum() == pytest.approx(length, abs=1e-12 * max(1, abs(start)))
    assert (mesh.h > 0).all() and mesh.h.max() <= interval * (1 + 1e-9)
    slack = mesh.tolerance
    for t in instants:
        if start < t < end:
            assert np.abs(mesh.t - t).min() <= slack
    assert (mesh.t[:-1] >= mesh.cell * interval - slack - 1e-12).all()
    assert (mesh.t[1:] <= (mesh.cell + 1) * interval + slack + 1e-12).all()
    np.testing.assert_array_equal(mesh.shared[:-1], mesh.cell[1:] == mesh.cell[:-1])


@given(st.floats(0, 5), st.floats(1e-6, 2), st.floats(0, 3), st.floats(0, 5))
def test_discounted_lengths_are_the_integrals(t, h, after, rate):
    """Exact and stable down to rate = 0."""
    end = t + h + after
    exact, _ = quad(lambda tau: np.exp(-rate * (end - tau)), t, t + h, epsabs=0, epsrel=1e-12)
    assert discounted_length(np.array([t]), np.array([h]), end, rate)[0] == pytest.approx(exact, rel=1e-9)


@given(st.integers(1, 4), st.integers(0, 2**16), st.integers(0, 4))
def test_roots_square_to_the_weight_also_when_semidefinite(n, seed, drop):
    """L' L = M for M of any rank."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(max(n - drop, 0), n))
    matrix = factor.T @ factor
    root = square_root(weight_matrix(matrix, tuple("abcd"[:n]), "test"))
    np.testing.assert_allclose(root.T @ root, matrix, atol=1e-9)


def test_the_weight_of_the_speaking_sensors_is_the_inverse_of_their_covariance():
    """Rows and columns leave the covariance, not the weight."""
    R = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.2], [0.5, -0.2, 2.0]])
    seen = np.array([True, False, True])
    expected = np.linalg.inv(np.linalg.inv(R)[np.ix_(seen, seen)])
    np.testing.assert_allclose(observed_part(R, seen)[np.ix_(seen, seen)], expected, rtol=1e-12)
