"""Matrix polynomials that are positive on a box, as sums of squares: the Gram matrices, and what they prove.

M(s) >= 0 for all s in [-1, 1]^n if ::

    M(s) = z_0(s)' G_0 z_0(s) + sum_i (1 - s_i^2) z_i(s)' G_i z_i(s),    G_i >= 0

where z_i are Chebyshev polynomials up to some degrees, one for each row of M (Scherer and Hol 2006; for one variable
nothing is lost). Both sides are polynomials of degree 2 e_i in s_i, so they are equal if they are at as many nodes as
that fixes; equations at nodes are better conditioned than equations between coefficients.

A solver meets these equations inexactly. The gap is a polynomial too, at most its largest value at the nodes times the
Lebesgue constant of the nodes; Gram matrices that are slightly indefinite take at most |eigenvalue| |z|^2 away. `worth`
subtracts both from the slack that was asked for: what is left over is proved, to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np

from ctmhe.certificates.lmi import require_cvxpy
from ctmhe.types import Array


@dataclass(frozen=True, eq=False)
class Squares:
    """Gram matrices for an m by m matrix polynomial of given degrees on [-1, 1]^n.

    Attributes
    ----------
    nodes : array (k, n)
        Where the matrix polynomial has to be known.
    bases : list of array (k, b_i)
        Chebyshev polynomials there, for each Gram matrix.
    weights : array (n + 1, k)
        1 and 1 - s_i^2 there.
    grams : list of cvxpy variables (m b_i, m b_i)
    lebesgue : float
    """

    nodes: Array
    bases: list[Array]
    weights: Array
    grams: list[Any]
    lebesgue: float

    def constraints(self, values: Sequence[Any], slack: float) -> list[Any]:
        """Return what makes M - slack a sum of squares; `values` are cvxpy expressions (m, m), one a node."""
        found: list[Any] = [gram >> 0 for gram in self.grams]
        for k, value in enumerate(values):
            size = value.shape[0]
            rest = value - slack * np.eye(size)
            for gram, basis, weight in zip(self.grams, self.bases, self.weights, strict=True):
                if weight[k] > 1e-14:
                    z = np.kron(basis[k][:, None], np.eye(size))
                    rest = rest - weight[k] * (z.T @ gram @ z)
            found.append(require_cvxpy().upper_tri(rest) == 0 if size > 1 else rest == 0)
            if size > 1:
                found.append(require_cvxpy().diag(rest) == 0)
        return found

    def worth(self, values: Array, slack: float) -> float:
        """Return a lower bound of the eigenvalues of M on the box, from its values (k, m, m) and the solved grams."""
        m, left, taken = values.shape[1], values - slack * np.eye(values.shape[1]), 0.0
        for gram, basis, weight in zip(self.grams, self.bases, self.weights, strict=True):
            G = (gram.value + gram.value.T) / 2
            blocks = G.reshape(basis.shape[1], m, basis.shape[1], m)
            left = left - weight[:, None, None] * np.einsum("ka,aibj,kb->kij", basis, blocks, basis)
            taken += max(0.0, -float(np.linalg.eigvalsh(G)[0])) * basis.shape[1]  # |z|^2 is at most that
        return slack - taken - self.lebesgue * float(np.abs(np.linalg.eigvalsh(left)).max())


def squares(size: int, degrees: Sequence[int], *, extra: int = 0) -> Squares:
    """Return the Gram matrices for a matrix polynomial.

    Parameters
    ----------
    size : int
        Rows of M.
    degrees : sequence of int
        Of M in each variable.
    extra : int
        By how much the degrees of the squares exceed those needed to write M: with more, more polynomials can be shown
        to be positive, at a price.
    """
    cp, n = require_cvxpy(), len(degrees)
    half = [(d + 1) // 2 + (extra if d else 0) for d in degrees]
    axes = [np.cos(pi * (np.arange(2 * e + 1) + 0.5) / (2 * e + 1)) for e in half]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n) if n else np.zeros((1, 0))
    bases, weights = [_chebyshev(nodes, half)], [np.ones(len(nodes))]
    for i, e in enumerate(half):
        if e:
            bases.append(_chebyshev(nodes, [h - (j == i) for j, h in enumerate(half)]))
            weights.append(1 - nodes[:, i] ** 2)
    grams = [_symmetric(cp, size * basis.shape[1]) for basis in bases]
    lebesgue = float(np.prod([1 + 2 / pi * np.log(2 * e + 1) for e in half]))
    return Squares(nodes, bases, np.array(weights), grams, lebesgue)


def _symmetric(cp: Any, size: int) -> Any:
    return cp.Variable((size, size), symmetric=True)


def _chebyshev(nodes: Array, degrees: Sequence[int]) -> Array:
    basis = np.ones((len(nodes), 1))
    for i, degree in enumerate(degrees):
        one = np.cos(np.arange(degree + 1) * np.arccos(nodes[:, i : i + 1]))
        basis = (basis[:, :, None] * one[:, None, :]).reshape(len(nodes), -1)
    return basis
