"""What an observer is fed with: inputs held, measurements held while they count, and flags that say so."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.data.window import fed_inputs

times = st.lists(st.integers(0, 40), min_size=1, max_size=12, unique=True).map(sorted)


@settings(max_examples=60, deadline=None)
@given(times, times, st.integers(1, 15), st.data())
def test_every_row_says_what_is_known_at_its_time(u_at, y_at, limit, data):
    """Between rows nothing changes, and at any time the row that holds is what a plain search of the records finds."""
    u_times, y_times = np.array(u_at) * 0.25, np.array(y_at) * 0.25
    u = np.arange(len(u_at), dtype=float)[:, None]
    cell = st.one_of(st.just(np.nan), st.floats(-5, 5))
    y = np.array(data.draw(st.lists(st.tuples(cell, cell), min_size=len(y_at), max_size=len(y_at))))
    cut = data.draw(st.one_of(st.just(np.inf), st.integers(0, 40).map(lambda k: k * 0.25)))
    limit = limit * 0.25
    at, rows = fed_inputs((u_times, u), (y_times, y), limit, cut)
    assert (np.diff(at) > 0).all()
    for t in np.arange(at[0], at[-1] + 1, 0.125):
        row = rows[np.searchsorted(at, t, side="right") - 1]
        assert row[0] == u[max(np.searchsorted(u_times, t, side="right") - 1, 0), 0]
        for s in range(2):
            spoken = np.flatnonzero(np.isfinite(y[:, s]) & (y_times <= t))
            known = len(spoken) and t < min(y_times[spoken[-1]] + limit, cut)
            assert row[3 + s] == bool(known)
            assert row[1 + s] == (y[spoken[-1], s] if known else 0.0)
