"""Models whose parameters vary are the models that they are made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe import InputError
from ctmhe.models.library import batch_reactor, chua_discrete
from ctmhe.models.varying import varying_parameters


@given(seed=st.integers(0, 10**6))
def test_states_and_parameters_move_as_they_should(seed):
    """f(x, p) beside p + w_p, the same outputs; in continuous time beside w_p; with g beside g."""
    rng = np.random.default_rng(seed)
    for model in (chua_discrete(), batch_reactor(parameters=("k1", "k2"))):
        wide, nx = varying_parameters(model, drift=1e-3), len(model.x)
        x, w, p, drift = (rng.uniform(0.1, 1, n) for n in (nx, len(model.w), len(model.p), len(model.p)))
        both = (0.0, np.append(x, p), [], np.append(w, drift), [])
        value = np.asarray(wide.dynamics(*both)).ravel()
        np.testing.assert_allclose(value[:nx], np.asarray(model.dynamics(0.0, x, [], w, p)).ravel())
        np.testing.assert_allclose(value[nx:], drift if model.step is None else p + drift)
        np.testing.assert_allclose(np.asarray(wide.output(*both)), np.asarray(model.output(0.0, x, [], w, p)))
        own = varying_parameters(model, lambda p, u, w: -2 * p)
        np.testing.assert_allclose(np.asarray(own.dynamics(0.0, both[1], [], w, [])).ravel()[nx:], -2 * p)
    assert wide.x.names == ("pA", "pB", "k1", "k2") and wide.w.names[-2:] == ("w_k1", "w_k2")


def test_bounds_and_units_come_along():
    """Boxes of p become boxes of states, `drift` those of the new disturbances."""
    wide = varying_parameters(chua_discrete(), drift={"p": 2e-4})
    assert wide.bounds.x["p"] == (0.2, 0.8) and wide.bounds.w["w_p"] == (-2e-4, 2e-4)
    assert wide.step == 0.01 and wide.w.nominal[-1] == 2e-4


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: varying_parameters(batch_reactor(), drift=1.0), "has no parameters"),
        (lambda: varying_parameters(chua_discrete()), "how fast"),
        (lambda: varying_parameters(chua_discrete(), drift={"q": 1.0}), "unknown parameter 'q'"),
    ],
)
def test_what_is_missing_is_named(make, text):
    """Errors say what to give."""
    with pytest.raises(InputError, match=text):
        make()
