"""Policies that compare an output with its prediction from the last estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext

NORMS = {"max": np.inf, "euclidean": 2, "sum": 1}


@dataclass(frozen=True, repr=False)
class Innovation(Trigger):
    """Sample when the output leaves its prediction: |y - y_hat| - threshold >= 0.

    With `covariance` S the norm is Mahalanobis', sqrt(e' S^-1 e), as the normalised innovation of Wu, Jia, Johansson,
    Shi, Event-based sensor data scheduling: trade-off between communication rate and estimation quality, IEEE Trans.
    Autom. Control 58 (2013). Outputs without a value (NaN) are passed over (row and column of S dropped).

    Parameters
    ----------
    threshold : float
        >= 0; in the outputs' unit, in standard deviations with `covariance`.
    norm : {"max", "euclidean", "sum"}
        Norm over the outputs; ignored with `covariance`.
    covariance : float, array (ny,) of variances or matrix (ny, ny), optional
        Covariance of the innovation, positive definite, in products of the outputs' units.
    """

    threshold: float
    norm: str = "max"
    covariance: ArrayLike | None = None

    def __post_init__(self) -> None:
        if isinstance(self.threshold, bool) or not isinstance(self.threshold, (int, float, np.number)):
            raise InputError(f"Innovation: threshold must be a number, got {self.threshold!r}")
        if not self.threshold >= 0:
            raise InputError(f"Innovation: threshold must be >= 0, got {self.threshold!r}")
        if self.norm not in NORMS:
            raise InputError(f"Innovation: norm must be one of {', '.join(NORMS)}, got {self.norm!r}")
        if self.covariance is not None:
            matrix = np.asarray(self.covariance, dtype=float)
            matrix = np.diag(np.atleast_1d(matrix)) if matrix.ndim < 2 else matrix
            symmetric = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1] and np.allclose(matrix, matrix.T)
            if not symmetric or not (np.linalg.eigvalsh(matrix) > 0).all():
                raise InputError(
                    "Innovation: covariance must be a symmetric positive definite matrix, or variances > 0"
                )
            object.__setattr__(self, "covariance", tuple(map(tuple, matrix.tolist())))

    def guard(self, ctx: TriggerContext) -> float:
        """Return the norm of the innovation minus the threshold."""
        known = ~np.isnan(ctx.y)
        if not known.any() or not np.isfinite(self.threshold):
            return -np.inf
        error = (ctx.y - ctx.y_hat)[known]
        if self.covariance is None:
            return float(np.linalg.norm(error, NORMS[self.norm])) - self.threshold
        matrix = np.asarray(self.covariance, dtype=float)
        if matrix.shape[0] != ctx.y.size:
            raise InputError(
                f"covariance is {matrix.shape}, but there are {ctx.y.size} outputs ({', '.join(ctx.outputs)})"
            )
        return float(np.sqrt(error @ np.linalg.solve(matrix[np.ix_(known, known)], error))) - self.threshold
