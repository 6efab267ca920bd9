"""An estimator that goes along with a run: what it was told, its last estimate, and what it expects from there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.errors import TooLate
from ctmhe.estimators.base import Estimator, EstimatorState
from ctmhe.transcription.grid import same_time
from ctmhe.types import Array, Estimate, Input, Measurement, Outcome, frozen


@dataclass(frozen=True, eq=False)
class Known:
    """A state (nx,) at an instant, and how certain it is: `covariance()` is (n, n)."""

    t: float
    x: Array
    covariance: Callable[[], Array]


class Forecast:
    """The open loop from one instant on, as a trigger sees it (`Outlook`); computed when asked, kept for the last time.

    States start at `since`. Covariances start at `known`, the last estimate, and go on from `whole`, the last edge of a
    disturbance cell that one was asked for behind, so that cells stay whole.
    """

    def __init__(
        self,
        estimator: Estimator,
        told: EstimatorState,
        since: float,
        x: Array,
        p: Array,
        known: Known,
        whole: Known | None = None,
    ):
        self.estimator, self.told = estimator, told
        self.since, self.x, self.p = since, x, p
        self.known, self.whole = known, known if whole is None else whole
        self.ahead: tuple[float, tuple[Array, Array]] = (np.nan, (x, x))
        self.spread: tuple[float, Array] = (np.nan, x)

    def state(self, t: float) -> Array:
        """Return the state predicted for `t`."""
        if t <= self.since:
            return self.x
        return self._both(t)[0]

    def output(self, t: float) -> Array:
        """Return the output predicted for `t`."""
        return self._both(t)[1]

    def covariance(self, t: float) -> Array:
        """Return the covariance predicted for `t`."""
        if self.spread[0] != t:
            self.spread = (t, frozen(self._spread(t)))
        return self.spread[1]

    def at(self, told: EstimatorState, t: float, unchanged: float = np.inf) -> Forecast:
        """Return the same from `t` on, for an estimator in state `told`; inputs are the same up to `unchanged`."""
        t = max(t, self.since)
        whole = self.whole if self.whole.t <= unchanged else None
        return Forecast(self.estimator, told, t, self.state(t), self.p, self.known, whole)

    def _spread(self, t: float) -> Array:
        start = self.whole if self.whole.t <= t else self.known
        interval, slack = self.estimator.interval, same_time(self.estimator.interval, t)
        edge = interval * np.floor((t + slack) / interval)
        edge = t if t - edge <= slack else edge
        if start.t < edge:  # come to stay at the edge of a cell
            x, _ = self.estimator.carry(self.told, start.t, edge, start.x, self.p)
            covariance = self._carried(start, edge)
            start = self.whole = Known(edge, x, lambda: covariance)
        return self._carried(start, t)

    def _carried(self, start: Known, t: float) -> Array:
        return self.estimator.propagate_covariance(self.told, start.t, t, start.x, self.p, start.covariance())

    def _both(self, t: float) -> tuple[Array, Array]:
        if self.ahead[0] != t:
            x, y = self.estimator.carry(self.told, self.since, t, self.x, self.p)
            self.ahead = (t, (frozen(x), frozen(y)))
        return self.ahead[1]


class Follower:
    """One estimator during one run. Its forecasts are values: they stay what they were when it learns more."""

    def __init__(self, estimator: Estimator, state: EstimatorState):
        self.estimator, self.guess = estimator, state.x
        self.state: Any = state
        self.estimate: Estimate | None = None
        known = Known(state.t, state.x, lambda: estimator.prior_covariance(state.t))
        self.forecast = Forecast(estimator, state, state.t, state.x, state.p, known)
        self.solves, self.taken, self.too_late = 0, 0, 0

    def tell(self, known: Input) -> None:
        """Let it know an input."""
        self.state = self.estimator.control(self.state, known)
        unchanged = -np.inf if self.estimator.input_linear else known.t
        self.forecast = self.forecast.at(self.state, self.forecast.since, unchanged)

    def observe(self, measurements: Iterable[Measurement]) -> int:
        """Hand over measurements; return how many it took, the others came too late."""
        taken = 0
        for measurement in measurements:
            try:
                self.state = self.estimator.observe(self.state, measurement)
                taken += 1
            except TooLate:
                self.too_late += 1
        self.taken += taken
        return taken

    def solve(self, t: float) -> Estimate:
        """Estimate at `t`."""
        self.state, estimate = self.estimator.estimate(self.state, t)
        x, p = self.state.x, self.state.p
        covariance = lambda: estimate.covariance  # noqa: E731
        if estimate.status.outcome is Outcome.PREDICTED:  # a solve that failed leaves the uncertainty as it was
            carried = self.forecast.covariance(t)
            covariance = lambda: carried  # noqa: E731
        self.estimate = estimate
        self.forecast = Forecast(self.estimator, self.state, t, x, p, Known(t, x, covariance))
        self.solves += 1
        return estimate

    def carry(self, t: float) -> None:
        """Go on from the prediction for `t`, so that predictions need not start at the last estimate again."""
        self.forecast = self.forecast.at(self.state, t)
