"""The two examples of paper 003: an unknown linear system in a polytope, and a nonlinear one beside another."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.polytope import mixture, polytope
from ctmhe.types import Array

UNKNOWN_A = ([[0, 0.72], [1, 0.28]], [[0, -0.59], [1, 1.57]], [[0, -0.35], [1, 1.26]])
UNKNOWN_C = ([[-1.46, -1.29]], [[-4.84, -2.90]], [[-0.09, -0.03]])
SYSTEM, MODEL = (0.22, 0.76, 0.02), (0.41, 0.22, 0.37)
SINE_A = ([[0, 1.30], [1, -1.52]], [[0, -2.44], [1, 0.66]], [[0, 1.31], [1, 2.81]])
SINE_C = [[0.5, 0.5]]


def unknown_linear() -> ContinuousModel:
    """Return the polytope of three linear systems in observer form, A_i = [0 a_1; 1 a_2], C_i = [c_1 c_2].

    The system lies at the weights (0.22, 0.76, 0.02), the nominal model at (0.41, 0.22, 0.37), which is where p starts.
    Two of the vertices have an eigenvalue on or near the unit circle.

    Returns
    -------
    DiscreteModel
        x = (x1, x2), w = (w_x1, w_x2), p = (alpha1, alpha2, alpha3), y = (y1); steps of 1 s.

    Source: paper 003, Section 4.1, (74)-(75).
    """
    return polytope(UNKNOWN_A, UNKNOWN_C, step=1.0, start=MODEL, name="unknown_linear", source="paper 003 (74)-(75)")


def unknown_linear_matrices(weights: object = SYSTEM) -> tuple[Array, Array]:
    """Return A (2, 2) and C (1, 2) of `unknown_linear` at given weights: the system's when left out."""
    return mixture(UNKNOWN_A, weights), mixture(UNKNOWN_C, weights)


def drifting_sine() -> DiscreteModel:
    """Return x1+ = x2 + w1, x2+ = p1 x1 + sin(p2 x2) + w2, y = (x1 + x2) / 2.

    p2 = 0.05; p1 changes in time as `sine_drift` says.

    Returns
    -------
    DiscreteModel
        x = (x1, x2), w = (w_x1, w_x2), p = (p1, p2), y = (y1); steps of 1 s.

    Source: paper 003, Section 4.2, (76).
    """
    return DiscreteModel(
        lambda t, x, u, w, p: (x[1] + w[0], p[0] * x[0] + ca.sin(p[1] * x[1]) + w[1]),
        lambda t, x, u, w, p: (x[0] + x[1]) / 2,
        step=1.0,
        x=("x1", "x2"),
        w=("w_x1", "w_x2"),
        p=("p1", "p2"),
        y="y1",
        p_start=(1.0, 0.05),
        name="drifting_sine",
        source="paper 003 (76)",
    )


def sine_drift(start: float, steps: int) -> Array:
    """Return p1 (steps,) of `drifting_sine`: p1(k+1) = 0.01 p1(k) sin(5 pi k / steps), constant in the last quarter.

    (77); as printed it is next to zero from the second step on.
    """
    p = np.empty(steps)
    p[0] = start
    for k in range(1, steps):
        p[k] = 0.01 * p[k - 1] * np.sin(5 * np.pi * k / steps) if k <= 0.75 * steps else p[k - 1]
    return p


def sine_polytope() -> ContinuousModel:
    """Return the polytope that the paper sets beside `drifting_sine`.

    Its vertices are in observer form, [0 a_1; 1 a_2], and the system in the other, [0 1; p1 .]: as printed no mixture
    is the system, unless p1 = 1.

    Returns
    -------
    DiscreteModel
        x = (x1, x2), w = (w_x1, w_x2), p = (alpha1, alpha2, alpha3), y = (y1); steps of 1 s.

    Source: paper 003, Section 4.2, (78).
    """
    return polytope(SINE_A, SINE_C, step=1.0, name="sine_polytope", source="paper 003 (78)")
