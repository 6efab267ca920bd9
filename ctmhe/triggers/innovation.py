"""Policies that compare an output with its prediction from the last estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import matrix_for, positive, weight_matrix, whole

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
        object.__setattr__(
            self, "threshold", positive(self.threshold, "Innovation: threshold", zero=True, infinite=True)
        )
        if self.norm not in NORMS:
            raise InputError(f"Innovation: norm must be one of {', '.join(NORMS)}, got {self.norm!r}")
        if self.covariance is not None:
            rows = weight_matrix(self.covariance, "Innovation: covariance", definite=True)
            object.__setattr__(self, "covariance", rows)

    def guard(self, ctx: TriggerContext) -> float:
        """Return the norm of the innovation minus the threshold."""
        known = ~np.isnan(ctx.y)
        if not known.any() or not np.isfinite(self.threshold):
            return -np.inf
        error = (ctx.y - ctx.y_hat)[known]
        if self.covariance is None:
            return float(np.linalg.norm(error, NORMS[self.norm])) - self.threshold
        matrix = matrix_for(self.covariance, ctx, "covariance")[np.ix_(known, known)]
        return float(np.sqrt(error @ np.linalg.solve(matrix, error))) - self.threshold


@dataclass(frozen=True, repr=False)
class Stochastic(Trigger):
    """Sample with probability 1 - exp(-e' Y e / 2), e = y - y_hat, at every monitoring time: small errors seldom.

    Where a threshold says "no sample, so the error was small" and makes it a truncated Gaussian, this rule leaves a
    Gaussian error Gaussian: the closed-loop schedule of Han, Mo, Wu, Weerakkody, Sinopoli, Shi, Stochastic
    event-triggered sensor schedule for remote state estimation, IEEE Trans. Autom. Control 60 (2015), 2661-2675. The
    number of samples depends on the monitoring step, at which lots are drawn. A lot depends on the run's seed, `seed`
    and the number of questions so far. Outputs without a value (NaN) are passed over.

    Parameters
    ----------
    Y : float, array (ny,) of weights or matrix (ny, ny)
        Positive semidefinite, in inverse products of the outputs' units; larger: more samples.
    seed : int
        Tells apart the lots of several policies of this kind in one run.
    """

    Y: ArrayLike = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "Y", weight_matrix(self.Y, "Stochastic: Y", definite=False))
        object.__setattr__(self, "seed", whole(self.seed, "Stochastic: seed", least=0))

    def init_state(self) -> Any:
        """Return the number of the first lot."""
        return 0

    def fires(self, ctx: TriggerContext) -> bool:
        """Return whether the lot says to sample."""
        known = ~np.isnan(ctx.y)
        if not known.any():
            return False
        error = (ctx.y - ctx.y_hat)[known]
        size = float(error @ matrix_for(self.Y, ctx, "Y")[np.ix_(known, known)] @ error)
        return bool(ctx.lots(crc32(b"Stochastic"), self.seed, ctx.state).random() < -np.expm1(-size / 2))

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Count the questions."""
        return ctx.state + 1
