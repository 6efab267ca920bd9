"""The monitor: its level bounds what a window tells of parameters from below, and names what it does not tell."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

from ctmhe import MHE, DiscountedCost, Excitation, MaxInterval, SingleSample, Uniform, simulate
from ctmhe.certificates.excitation import ExcitationMonitor
from ctmhe.certificates.excitation_design import design_excitation
from ctmhe.certificates.joint import certify_jointly
from ctmhe.errors import InputError
from ctmhe.models.library import chua, chua_discrete
from ctmhe.triggers import WindowExcitation
from tests.certificates.trajectories import decay, mixer, trajectory

settings.register_profile("certificates", deadline=None, max_examples=10)
settings.load_profile("certificates")


@cache
def monitor(name: str, mu: float = 0.8) -> ExcitationMonitor:
    model = {"chua": chua, "chua_discrete": chua_discrete, "mixer": mixer, "decay": decay}[name]()
    return ExcitationMonitor(design_excitation(model, u=(-1, 1), mu=mu))


def fisher(design, jacobians) -> np.ndarray:
    """Information on p of the least-squares problem mu^T |dx0|^2_P + sum mu^(T-1-j) (|dw|^2_Q + |dy|^2_R).

    Written out: dy as a linear map of (dx0, dw, dp), the Hessian, and the Schur complement of all that is not p.
    """
    A, B, E, C, D, F = jacobians
    N, n = A.shape[:2]
    nw, o = B.shape[2], E.shape[2]
    state = np.hstack([np.eye(n), np.zeros((n, N * nw + o))])
    hessian = block_diag(
        design.mu**N * design.P, *(design.mu ** (N - 1 - j) * design.Q for j in range(N)), np.zeros((o, o))
    )
    for j in range(N):
        pick = np.zeros((nw, n + N * nw + o))
        pick[:, n + j * nw : n + (j + 1) * nw] = np.eye(nw)
        own = np.hstack([np.zeros((o, n + N * nw)), np.eye(o)])
        seen = C[j] @ state + D[j] @ pick + F[j] @ own
        hessian += design.mu ** (N - 1 - j) * seen.T @ design.R @ seen
        state = A[j] @ state + B[j] @ pick + E[j] @ own
    rest = hessian[:-o, :-o]
    return hessian[-o:, -o:] - hessian[-o:, :-o] @ np.linalg.solve(rest, hessian[:-o, -o:])


@pytest.mark.parametrize("name", ["chua_discrete", "mixer"])
@given(seed=st.integers(0, 10**6), steps=st.integers(1, 25))
def test_the_information_is_at_least_what_the_monitor_says(name, seed, steps):
    """C_T is below the information that the window's least-squares problem has on p, its start and w unknown."""
    watch, rng = monitor(name), np.random.default_rng(seed)
    first = trajectory(watch.design.model, steps, rng)
    second = trajectory(watch.design.model, steps, rng, u=first.u0)
    rows = [np.hstack([t.x[:-1], t.u0, t.w, np.tile(t.p, (steps, 1))]) for t in (first, second)]
    true = fisher(watch.design, watch.design.increments.between(*rows))
    claimed = watch.between(first, second).matrix
    size = np.sqrt(np.outer(np.diag(true), np.diag(true))) + 1e-30
    assert np.linalg.eigvalsh((true - claimed) / size.max()).min() >= -1e-9


@pytest.mark.parametrize("name", ["chua_discrete", "mixer", "decay"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=10)
def test_where_the_design_is_global_one_trajectory_speaks_for_every_pair(name, seed):
    """Corollary 7.2: C_T(Z1, Z2) = O_T(Z1)."""
    watch, rng = monitor(name), np.random.default_rng(seed)
    first = trajectory(watch.design.model, 15, rng, h=0.05)
    second = trajectory(watch.design.model, 15, rng, h=0.05, u=first.u0)
    np.testing.assert_allclose(watch.between(first, second).matrix, watch.along(first).matrix, rtol=1e-8, atol=1e-12)


def test_levels_do_not_depend_on_the_unit_of_a_parameter():
    """A gain in thousandths: the level, what the set says of the parameters, and kappa stay."""
    plain, milli = (ExcitationMonitor(design_excitation(mixer(unit=unit), u=(-1, 1), mu=0.8)) for unit in (1.0, 1e3))
    run = trajectory(plain.design.model, 20, np.random.default_rng(0))
    other = replace(run, p=run.p * [1e3, 1.0])
    level = plain.level(run)
    assert milli.level(other) == pytest.approx(level, rel=1e-6)
    sets = plain.design.excited_set(level), milli.design.excited_set(level)
    assert other.p @ sets[1].S @ other.p == pytest.approx(run.p @ sets[0].S @ run.p)
    kappas = [certify_jointly(watch.design, alpha=level).kappa for watch in (plain, milli)]
    assert kappas[1] == pytest.approx(kappas[0], rel=1e-2)


def test_the_sums_are_the_printed_ones():
    """(7.44), (7.45) and paper 000 (18)-(19), (34) written out for five steps of the mixer."""
    watch = monitor("mixer")
    run, design = trajectory(watch.design.model, 5, np.random.default_rng(0)), watch.design
    Y0, S0 = np.array([[0.1, 0.2], [0.0, -0.3]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    Y, S, plain = Y0, S0, 0
    for x, u in zip(run.x[:-1], run.u0, strict=True):
        G = np.array([[u[0], 0.0], [0.0, x[0]]])
        S, plain = design.mu * S + Y.T @ design.C.T @ design.C @ Y, plain + Y.T @ design.C.T @ design.C @ Y
        Y = design.Phi @ Y + G
    found = watch.along(run, start=(Y0, S0))
    for ours, theirs in ((found.Y, Y), (found.matrix, S), (found.undiscounted, plain)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10)


def test_in_continuous_time_the_sums_converge_to_the_integrals():
    """Against an ODE solver for (x, Y, S): the error falls by four as slots are halved, Phi being fast."""
    watch = monitor("decay", 1e-4)
    design, model = watch.design, watch.design.model
    k, u = 0.8, lambda t: np.array([1.0 + np.sin(3 * t)])
    phi, errors = design.Phi[0, 0], []

    def flow(t, z):
        x, Y, S, _ = z
        return [-k * x + u(t)[0], phi * Y - x, np.log(design.mu) * S + Y**2, Y**2]

    truth = solve_ivp(flow, (0, 2.0), [1.0, 0, 0, 0], rtol=1e-10, atol=1e-13, dense_output=True)
    for N in (20, 40, 80):
        t = np.linspace(0, 2, N + 1)
        ends = np.array([u(s) for s in t])
        run = trajectory(model, N, np.random.default_rng(0), h=2.0 / N)
        run = replace(run, t=t, x=truth.sol(t)[:1].T, w=np.zeros((N, 2)), u0=ends[:-1], u1=ends[1:], p=np.array([k]))
        found = watch.along(run)
        errors.append(abs(found.matrix[0, 0] - truth.y[2, -1]) / truth.y[2, -1])
    assert errors[0] < 0.05 and errors[1] < errors[0] / 3 and errors[2] < errors[1] / 3


def test_a_parameter_without_effect_is_named():
    """With no input the gain does nothing: the level is zero, and the directions tell which combination is unknown."""
    watch = monitor("mixer")
    model = watch.design.model
    silent = trajectory(model, 20, np.random.default_rng(1), u=np.zeros((20, 1)))
    found = watch.along(silent)
    assert found.level == pytest.approx(0, abs=1e-12)
    least, most = found.directions
    assert least.level == pytest.approx(0, abs=1e-12) and abs(least.weights["gain"]) == pytest.approx(1)
    assert most.level > 0 and abs(most.weights["feed"]) == pytest.approx(1) and "feed" in str(most)
    assert found.excited(most.level / 2).shape == (2, 1)
    full = watch.along(trajectory(model, 20, np.random.default_rng(1)))
    assert full.excited(full.directions[0].level / 2).shape == (2, 2)


def test_nothing_moves_nothing_is_learnt_of_the_cubic():
    """x1 = 0: the parameter of the Chua circuit enters by p x1^3 only."""
    watch = monitor("chua_discrete")
    still = trajectory(watch.design.model, 50, np.random.default_rng(0), x=np.zeros(3), w=np.zeros((50, 4)))
    assert watch.level(still) == 0


@pytest.mark.parametrize("name", ["chua_discrete", "decay"])
def test_a_trajectory_continued_is_the_longer_trajectory(name):
    """`until` carries on with w = 0 and the last input, at the cost of the integration error only."""
    watch, rng = monitor(name), np.random.default_rng(5)
    h, N = watch.design.model.step or 0.02, 30
    long = trajectory(watch.design.model, N, rng, h=h, size=0.0, u=np.full((N, len(watch.design.model.u)), 0.5))
    cut = {key: getattr(long, key)[:20] for key in ("w", "y", "u0", "u1")}
    short = replace(long, t=long.t[:21], x=long.x[:21], **cut)
    np.testing.assert_allclose(watch.level(short, until=float(long.t[-1])), watch.level(long), rtol=1e-6)
    assert watch.level(short, until=float(short.t[-1])) == watch.level(short)


def test_bad_trajectories_are_refused():
    """Different meshes of a pair; a start of the wrong shape."""
    watch, rng = monitor("mixer"), np.random.default_rng(0)
    run = trajectory(watch.design.model, 5, rng)
    with pytest.raises(InputError, match="same nodes"):
        watch.between(run, trajectory(watch.design.model, 6, rng))
    with pytest.raises(InputError, match=r"expected Y \(2, 2\) and S \(2, 2\)"):
        watch.along(run, start=(np.zeros((2, 1)), np.zeros((2, 2))))
    with pytest.raises(InputError, match="WindowExcitation: expected ExcitationMonitor"):
        WindowExcitation(watch.design)


def test_the_trigger_samples_while_the_parameter_shows():
    """Joint estimation of thesis 5.2.4, 6 s: a sample a step while the window is excited, else the longest wait.

    x1 is at least 1 until 3 s and within 0.1 from 4.7 s on, where p x1^3 says nothing.
    """
    model = chua_discrete()
    mhe = MHE(
        model,
        horizon=0.6,
        cost=DiscountedCost(P=np.diag([1, 1, 1, 10.0]), Q=[1e6, 1e6, 1e6, 100.0], R=100.0, eta=0.98),
        bounds=model.bounds,
    )
    policy = Excitation(WindowExcitation(monitor("chua_discrete", 0.95)), 0.1) | MaxInterval(0.1)
    assert repr(pickle.loads(pickle.dumps(policy))) == repr(policy)
    run = simulate(
        model,
        mhe,
        trigger=policy,
        until=6.0,
        truth=[1.0, 0.0, -1.0],
        guess=[0.8, 0.0, -0.8],
        p_true=[0.45],
        p=[0.5],
        channel=SingleSample(),
        disturbance={"v_voltage": Uniform(0.01)},
        monitor=0.01,
        seed=0,
    )
    x1 = np.abs(run.dataset["x_true"].values[:, 0])
    assert (x1[run.t > 4.7] < 0.1).all() and (x1[run.t < 3.0] >= 1.0).all()
    np.testing.assert_allclose(run.gaps[run.sample_times > 4.8], 0.1)
    dense = (run.sample_times > 2.2) & (run.sample_times < 3.0)
    np.testing.assert_allclose(run.gaps[dense], 0.01)
    # early samples are those of an excited window, told by the recorded level: the guard's, inf where the wait is over
    early = run.sample_times[run.gaps < 0.095]
    level = run.dataset["level"].values[np.round(early / 0.01).astype(int)]
    assert (level >= 0).all()
