"""What a certificate guarantees, and how it is scaled to other weights."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.certificates.certificate import DetectabilityCertificate, largest_ratio
from ctmhe.errors import InputError
from ctmhe.types import DiscountedCost

P = np.array([[4.009, 3.768], [3.768, 3.549]])  # thesis 3.4.1, continuous time
REACTOR = DetectabilityCertificate(P, P, np.diag([1e3, 1e3, 1e2]), [[1e2]], 0.4)


def definite(seed, n):
    """A random positive definite matrix."""
    root = np.random.default_rng(seed).normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def test_the_numbers_of_the_thesis():
    """T_min = 1.70 s and rho = 0.860 for a horizon of 2 s and waits of 0.19 s (thesis 3.4.1)."""
    assert REACTOR.shortest_horizon(wait=0.19) == pytest.approx(1.70, abs=0.005)
    assert REACTOR.contraction(2.0, wait=0.19) == pytest.approx(0.860, abs=5e-4)


@given(seed=st.integers(0, 10**6), eta=st.floats(0.05, 0.99), extra=st.floats(1e-3, 10))
def test_rate_horizon_and_wait_say_the_same(seed, eta, extra):
    """rho < 1 exactly when the wait stays below its limit, and that limit is the horizon beyond T_min."""
    upper = definite(seed, 3)
    certificate = DetectabilityCertificate(upper / 2, upper, np.eye(2), np.eye(1), eta)
    assert certificate.ratio == pytest.approx(2.0)
    horizon = certificate.shortest_horizon() + extra
    limit = certificate.longest_wait(horizon)
    assert limit == pytest.approx(extra, rel=1e-6)
    assert (
        certificate.contraction(horizon, wait=0.999 * limit) < 1 < certificate.contraction(horizon, wait=1.001 * limit)
    )


@given(seed=st.integers(0, 10**6), factor=st.floats(1e-3, 1e3))
def test_weights_of_ones_own_keep_the_dissipation(seed, factor):
    """K P_upper, K Q and K R do not exceed the weights asked for, one of them is met, and P_lower is K times itself."""
    own = DetectabilityCertificate(
        definite(seed, 2), definite(seed, 2), definite(seed + 1, 3), definite(seed + 2, 1), 0.4
    )
    wanted = definite(seed + 3, 2), definite(seed + 4, 3), factor * definite(seed + 5, 1)
    scaled = own.for_weights(*wanted, eta=0.7)
    K = scaled.P_lower[0, 0] / own.P_lower[0, 0]
    used = [largest_ratio(K * a, b) for a, b in zip((own.P_upper, own.Q, own.R), wanted, strict=True)]
    assert max(used) == pytest.approx(1.0)
    assert scaled.eta == 0.7 and scaled.ratio >= 1
    again = own.for_weights(*(factor * part for part in wanted))
    assert again.ratio == pytest.approx(scaled.ratio, rel=1e-6)  # a common factor of all weights changes nothing


def test_the_cost_of_a_certificate_doubles_p_and_q():
    """The theory's cost has 2 P_upper, 2 Q and R (thesis 3.2.2)."""
    cost = DiscountedCost.from_certificate(REACTOR)
    assert np.array_equal(cost.P, 2 * P) and np.array_equal(cost.R, [[1e2]]) and cost.eta == 0.4
    assert np.array_equal(cost.Q, 2 * REACTOR.Q)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"P_lower": -P}, "positive definite"),
        ({"P_lower": 2 * P}, "must not exceed"),
        ({"P_upper": np.eye(3)}, "bound one function"),
        ({"Q": np.array([[1.0, 2.0], [0.0, 1.0]])}, "symmetric"),
        ({"R": np.array([[np.nan]])}, "finite"),
        ({"eta": 1.0}, "eta must lie"),
    ],
)
def test_matrices_that_cannot_be(change, message):
    """What is wrong is said by name."""
    fields = {"P_lower": P, "P_upper": P, "Q": np.eye(3), "R": np.eye(1), "eta": 0.4}
    with pytest.raises(InputError, match=message):
        DetectabilityCertificate(**fields | change)


def test_weights_that_cannot_be():
    """Singular weights, wrong sizes and a faster discount are refused."""
    for weights, message in (((0.0, 1, 1), "P must be"), ((1, [1, 2], 1), "expected a scalar")):
        with pytest.raises(InputError, match=message):
            REACTOR.for_weights(*weights)
    with pytest.raises(InputError, match="only slower fading"):
        REACTOR.for_weights(1, 1, 1, eta=0.3)
