"""Random stable linear systems of any size, from a seed."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array, frozen


def random_stable(states: int, inputs: int, outputs: int, *, seed: Any = 0) -> tuple[Array, Array, Array]:
    """Return A, B, C of x(k+1) = A x(k) + B u(k), y(k) = C x(k), stable, drawn at random.

    Half of the poles, rounded, are real and uniform in (-1, 1); the others are pairs with a modulus uniform in (0, 1)
    and an angle uniform in (0, pi). A is the block-diagonal matrix of these poles seen in a random orthonormal basis,
    so that its norm is below 1. The entries of B and C are standard normal, a quarter of those of B are zero.

    The source draws its systems by a command of MATLAB (`drss`), whose numbers nobody else can draw; this is a
    generator of the same kind, not the same systems.

    Parameters
    ----------
    states, inputs, outputs : int
    seed : int or numpy.random.Generator

    Returns
    -------
    A : array (states, states), B : array (states, inputs), C : array (outputs, states)

    Raises
    ------
    InputError
        For sizes that are not positive.

    Source: thesis, Section 6.4.1, Table 6.2.
    """
    for name, size in (("states", states), ("inputs", inputs), ("outputs", outputs)):
        if not (isinstance(size, int) and size > 0):
            raise InputError(f"random_stable: {name} must be a positive integer, got {size!r}")
    rng = np.random.default_rng(seed)
    pairs = states // 4
    A = np.diag(rng.uniform(-1.0, 1.0, states))
    for i in range(pairs):
        modulus, angle = rng.uniform(0.0, 1.0), rng.uniform(0.0, np.pi)
        real, imaginary = modulus * np.cos(angle), modulus * np.sin(angle)
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[real, imaginary], [-imaginary, real]]
    basis, triangle = np.linalg.qr(rng.normal(size=(states, states)))
    basis = basis * np.sign(np.diagonal(triangle))  # uniform over all bases
    B = rng.normal(size=(states, inputs)) * (rng.uniform(size=(states, inputs)) < 0.75)
    return frozen(basis.T @ A @ basis), frozen(B), frozen(rng.normal(size=(outputs, states)))
