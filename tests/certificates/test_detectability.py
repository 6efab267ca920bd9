"""What a certificate of detectability claims holds for pairs that the solver never saw; where there is none, why."""

from __future__ import annotations

from inspect import signature

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from ctmhe.certificates import certify_detectability
from ctmhe.certificates.increments import Cover, Increments
from ctmhe.certificates.inequality import Form, Sizes
from ctmhe.certificates.injection import Units
from ctmhe.errors import CertificateError, InputError
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import batch_reactor, chua_discrete, cstr, van_der_pol
from ctmhe.types import Bounds
from tests.certificates.trajectories import quadratic

settings.register_profile("certificates", deadline=None, max_examples=20)
settings.load_profile("certificates")
PAIRS = 50_000  # a million over the examples


def shaped(f, h, *, discrete=False, bounds=None, **signals):
    """A model of two states with noise on both and on the output."""
    box = bounds or Bounds(x=(-1, 1), w=(-0.1, 0.1))
    signals = {"x": ("a", "b"), "w": ("w_a", "w_b", "v"), "y": "y", "bounds": box, "name": "shaped"} | signals
    return DiscreteModel(f, h, step=1.0, **signals) if discrete else ContinuousModel(f, h, **signals)


def random_model(rng, *, discrete, curved):
    """Quadratic dynamics and an output that is affine, or quadratic; detectable or not."""
    A, bend = rng.normal(size=(2, 2)), 0.1 * rng.normal(size=(2, 3))
    A = 0.5 * A + 0.3 * np.eye(2) if discrete else A - 0.3 * np.eye(2)
    C, arch = rng.normal(size=2) * (rng.uniform(size=2) < 0.8), 0.1 * rng.normal(size=3) * curved

    def squares(x):
        return ca.vertcat(x[0] ** 2, x[0] * x[1], x[1] ** 2)

    return shaped(
        lambda t, x, u, w, p: ca.DM(A) @ x + ca.DM(bend) @ squares(x) + w[:2],
        lambda t, x, u, w, p: ca.DM(C).T @ x + ca.DM(arch).T @ squares(x) + w[2],
        discrete=discrete,
    )


def slack(model, found, v1, v2):
    """eta U + |dw|^2_Q + |dy|^2_R - U+ over the size of the pair; by differences of f and h, not by their Jacobians."""
    edges = np.cumsum([0, *(len(getattr(model, key)) for key in "xuwp")])
    place = {key: slice(edges[i], edges[i + 1]) for i, key in enumerate("xuwp")}
    values = []
    for v in (v1, v2):
        groups = [ca.DM(v[:, place[key]].T) for key in "xuwp"]
        values.append([np.asarray(ca.DM(g(0.0, *groups))).T for g in (model.dynamics, model.output)])
    dx, dw = (v1 - v2)[:, place["x"]], (v1 - v2)[:, place["w"]]
    df, dy = (one - two for one, two in zip(*values, strict=True))
    supply = quadratic(found.Q, dw) + quadratic(found.R, dy)
    if model.step:
        left = found.eta * quadratic(found.P_lower, dx) + supply - quadratic(found.P_lower, df)
    else:
        left = np.log(found.eta) * quadratic(found.P_lower, dx) + supply - 2 * np.sum(dx @ found.P_lower * df, axis=1)
    return left / np.maximum(np.sum(dx**2, axis=1) + np.sum(dw**2, axis=1), 1e-12)


@given(st.integers(0, 10**6), st.booleans(), st.booleans(), st.floats(0.05, 0.95))
def test_no_search_refutes_a_certificate(seed, discrete, curved, eta):
    """Random pairs and an optimiser from the worst of them never break (7.2b), (7.31b) of what was proved."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, discrete=discrete, curved=curved)
    try:
        found = certify_detectability(model, eta=eta)
    except CertificateError:
        return
    increments, size = Increments(model), 1e-12 * (1 + np.abs(found.R).max() + np.abs(found.P_lower).max())
    assert found.rigorous and found.margin >= -size
    v1, v2 = increments.random_pairs(PAIRS, rng)
    v2[: PAIRS // 2] = v1[: PAIRS // 2] + 1e-2 * (v2 - v1)[: PAIRS // 2]
    values, size = slack(model, found, v1, v2), 1e3 * size  # differences of f and h cancel digits of close pairs
    assert values.min() >= -size
    worst = np.argmin(values)
    bounds = 2 * list(zip(increments.lower, increments.upper, strict=True))
    n = len(increments.lower)
    best = minimize(
        lambda z: slack(model, found, z[None, :n], z[None, n:])[0], np.r_[v1[worst], v2[worst]],
        method="Powell", bounds=bounds, options={"maxfev": 300},
    )  # fmt: skip
    assert best.fun >= -size


@given(st.integers(0, 10**6), st.booleans())
def test_what_is_not_detectable_is_never_accepted(seed, discrete):
    """A state that grows and shows nowhere, in coordinates turned at random: refused, and its direction is named."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    A = turn @ np.diag([rng.uniform(-0.9, 0.9), 1.02 if discrete else 0.02]) @ turn.T
    model = shaped(
        lambda t, x, u, w, p: ca.DM(A) @ x + w[:2], lambda t, x, u, w, p: ca.DM(turn[:, 0]).T @ x + w[2],
        discrete=discrete,
    )  # fmt: skip
    with pytest.raises(CertificateError, match=r"not detectable: at .* outputs do not see the direction") as raised:
        certify_detectability(model)
    shown = turn[:, 1] * np.sign(turn[np.argmax(np.abs(turn[:, 1])), 1])
    if np.abs(shown).min() > 0.05:
        assert f"{np.abs(shown[0]):.2g} a" in str(raised.value) and f"{np.abs(shown[1]):.2g} b" in str(raised.value)
    with pytest.raises(CertificateError, match="outputs do not see"):
        certify_detectability(model, eta=0.9)


def test_linear_systems_reach_the_rate_of_their_unseen_mode():
    """An unseen state that fades by exp(-t) lets U fade by exp(-2 t), and no faster."""
    model = shaped(lambda t, x, u, w, p: (x[0] + w[0], -x[1] + w[1]), lambda t, x, u, w, p: x[0] + w[2])
    found = certify_detectability(model)
    assert found.method == "constant" and found.rigorous
    assert -np.log(found.eta) == pytest.approx(2.0, rel=0.02)
    with pytest.raises(CertificateError, match=r"direction 1 b .*which changes by exp\(-1 t\)"):
        certify_detectability(model, rate=2.1)


def test_slow_and_fast_clocks_give_the_same_certificate():
    """Seconds or minutes: eta counts the same decay."""
    rates = []
    for second in (1.0, 60.0):  # a unit of time
        model = shaped(
            lambda t, x, u, w, p, s=second: (s * (x[0] + x[1] ** 2 + w[0]), s * (-x[1] + w[1])),
            lambda t, x, u, w, p: x[0] + w[2],
        )
        rates.append(-np.log(certify_detectability(model).eta) / second)
    assert rates[0] == pytest.approx(rates[1], rel=0.02)


def test_given_weights_are_kept_and_only_checked():
    """With P, Q, R and eta nothing is searched; scaled up it still holds, and not at a faster rate than it has."""
    model = batch_reactor()
    found = certify_detectability(model, eta=0.5)
    same = certify_detectability(model, eta=0.5, P=found.P_lower, Q=found.Q, R=found.R)
    np.testing.assert_array_equal(same.P_lower, found.P_lower)
    assert same.margin == pytest.approx(found.margin, abs=1e-6)
    with pytest.raises(CertificateError, match=r"fails at eta = 0.45 by .* at pA = "):
        certify_detectability(model, eta=0.45, P=found.P_lower, Q=found.Q, R=found.R)


def test_objectives_do_what_they_say():
    """Each is best at its own aim, among all of them at the same rate."""
    model, Q, R = batch_reactor(), np.diag([1e3, 1e3, 1e2]), 1e2
    found = {
        aim: certify_detectability(model, eta=0.6, Q=Q, R=R, objective=aim) for aim in ("gain", "P", "conditioning")
    }
    least = {aim: np.linalg.eigvalsh(one.P_lower)[0] for aim, one in found.items()}
    spread = {aim: np.linalg.cond(one.P_lower) for aim, one in found.items()}
    assert least["P"] >= max(least.values()) * (1 - 1e-3)
    assert spread["conditioning"] <= min(spread.values()) * (1 + 1e-2)
    own = certify_detectability(model, P=1.0, Q=Q, R=R, objective="horizon")
    np.testing.assert_allclose(own.P_upper, np.eye(2))
    by_hand = [
        certify_detectability(model, eta=eta, Q=Q, R=R, objective="P").for_weights(1.0, Q, R) for eta in (0.3, 0.6)
    ]
    assert own.shortest_horizon() <= min(one.shortest_horizon() for one in by_hand) * 1.01


def test_curved_outputs_are_proved_and_pairs_confirm_them():
    """Theorem 7.2 asks for affine outputs; the bound that is affine in their Jacobian does not."""
    model = shaped(
        lambda t, x, u, w, p: (-x[0] + x[1] + w[0], -0.5 * x[0] + w[1]),
        lambda t, x, u, w, p: x[0] + 0.3 * x[0] ** 2 + w[2],
    )
    found = certify_detectability(model, eta=0.5)
    assert found.rigorous and "not affine" in found.notes[0] and "a (second)" in (found.worst or {})
    v1, v2 = Increments(model).random_pairs(20_000, np.random.default_rng(0))
    assert slack(model, found, v1, v2).min() >= -1e-9


def test_the_bound_of_curved_outputs_is_below_them():
    """h'R h >= h'N + N'h - N'R^-1 N for every N, with equality at N = R h."""
    model, rng = van_der_pol(), np.random.default_rng(0)
    increments, sizes = Increments(model, Bounds(x=(-2, 2))), Sizes(Units.of(model))
    points = increments.at(increments.random(30, rng))
    plain = Form(np.eye(2), (np.eye(len(model.w)),), np.array([[2.0]]))
    _, h = sizes.stacked(points)
    above = sizes.margins(plain, 0.5, points)
    bound = Form(plain.P, plain.W, plain.R, plain.R @ h[0] + rng.normal(size=h[0].shape))
    assert (sizes.margins(bound, 0.5, points) <= above + 1e-12).all()
    exact = Form(plain.P, plain.W, plain.R, plain.R @ h[0])
    np.testing.assert_allclose(sizes.margins(exact, 0.5, points), above, atol=1e-12)


def test_a_grid_is_called_evidence_and_its_worst_point_is_named():
    """What is sampled says so, and is sampled again, where no one chose the points."""
    model = van_der_pol()
    increments = Increments(model, Bounds(x=(-2, 2)))
    grid = Cover(increments.at(increments.random(20, np.random.default_rng(0))), "grid", rigorous=False)
    found = certify_detectability(model, Bounds(x=(-2, 2)), eta=0.5, jacobians=grid)
    assert found.method == "grid" and not found.rigorous and found.margin >= 0
    assert "evidence, not proof" in " ".join(found.notes) and set(found.worst or {}) == set(increments.names)


def test_an_fmu_is_evidence_and_close_to_its_equations():
    """Derivatives of a binary can be sampled only; at its equations' Jacobians the certificate holds all the same."""
    build = pytest.importorskip("fmus.build").build
    from ctmhe.models.fmu import FmuModel

    model = batch_reactor(noise=False)
    fmu = FmuModel(build("batch_reactor", fmi=2), inputs=[])
    with pytest.raises(InputError, match="depend on disturbance"):  # of a binary nobody knows that it does not
        certify_detectability(fmu, Bounds(x=(0.1, 5.0)), eta=0.6)
    found = certify_detectability(fmu, Bounds(x=(0.1, 5.0), w=(-0.1, 0.1)), eta=0.6)
    assert found.method == "grid" and not found.rigorous and found.notes[0].startswith("evidence, not proof")
    same = certify_detectability(model, eta=0.6 * 1.02, P=found.P_lower, Q=found.Q, R=found.R)
    assert same.rigorous


def test_domains_that_are_left_say_where():
    """A note, no refusal: pairs are certified while they stay inside."""
    grows = shaped(lambda t, x, u, w, p: (x[0] + w[0], -x[1]), lambda t, x, u, w, p: x[0] + w[2])
    notes = " ".join(certify_detectability(grows, eta=0.5).notes)
    assert "not invariant" in notes and "a = -1, a = 1" in notes and "b =" not in notes
    steps = chua_discrete(parameters=())
    assert any("not invariant" in note for note in certify_detectability(steps, eta=0.9).notes)


def test_parameters_are_known_and_anywhere_in_their_box():
    """The certificate of the box holds at each of its values."""
    model = van_der_pol(parameters=("mu",))
    found = certify_detectability(model, Bounds(x=(-2, 2), p=(0.5, 1.5)), eta=0.3)
    v1, v2 = Increments(model, Bounds(x=(-2, 2), w=(-1, 1), p=(0.5, 1.5))).random_pairs(
        20_000, np.random.default_rng(1)
    )
    v2[:, -1] = v1[:, -1]
    assert found.rigorous and slack(model, found, v1, v2).min() >= -1e-9


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"eta": 1.0}, InputError, r"eta must lie in \(0, 1\)"),
        ({"eta": 0.5, "rate": 1.0}, InputError, "eta or rate"),
        ({"rate": -1.0}, InputError, "rate must be positive"),
        ({"eta": 0.5, "objective": "rate"}, InputError, "finds eta: leave it out"),
        ({"objective": "gain"}, InputError, "needs eta= or rate="),
        ({"eta": 0.5, "objective": "speed"}, InputError, "one of gain, rate, P"),
        ({"eta": 0.5, "objective": "P"}, InputError, "needs Q= and R="),
        ({"eta": 0.5, "P": [[1.0, 1.0], [1.0, 1.0]]}, InputError, "P must be positive definite"),
        ({"eta": 0.5, "Q": [1.0, 2.0]}, InputError, r"Q: expected .* \(3, 3\)"),
        ({"eta": 0.5, "domain": Bounds()}, InputError, "depend on state 'pA', without finite bounds there"),
        ({"eta": 0.1, "P": 1.0, "Q": 1.0, "R": 1.0}, CertificateError, "the inequality fails at eta = 0.1 by"),
        ({"eta": 0.1, "P": 1.0}, CertificateError, "no quadratic function at eta = 0.1: .*infeasible"),
    ],
)  # fmt: skip
def test_bad_questions_get_an_answer(arguments, error, match):
    """What is missing and what to try."""
    with pytest.raises(error, match=match):
        certify_detectability(batch_reactor(), **arguments)


def test_models_that_jump_are_refused():
    """A Jacobian does not see a jump; a kink it does, as evidence."""
    jumps = shaped(lambda t, x, u, w, p: (-ca.sign(x[0]), -x[1]), lambda t, x, u, w, p: x[0])
    with pytest.raises(InputError, match="f uses sign and may jump"):
        certify_detectability(jumps, eta=0.5)


def test_a_failing_solver_is_not_the_last_word(monkeypatch):
    """The text says what was tried and what to try."""
    from ctmhe.certificates import inequality

    def fails(problem):
        raise CertificateError("the semidefinite program could not be solved: try a slower rate")

    monkeypatch.setattr(inequality, "solved", fails)
    with pytest.raises(CertificateError, match=r"no quadratic function at eta = 0.5: .* try a slower rate"):
        certify_detectability(batch_reactor(), eta=0.5)


def test_a_tank_reactor_is_certified_as_it_is():
    """Stiff, in units of very different size, with an input that changes the Jacobian."""
    domain = Bounds(x={"c": (0.5, 1.0), "T": (320.0, 335.0), "h": (0.5, 0.8)})
    try:
        found = certify_detectability(cstr(), domain, u=(0.05, 320.0), eta=0.9)
    except CertificateError as error:
        assert "try" in str(error)
    else:
        assert found.margin >= 0


@pytest.mark.skipif("given" not in signature(Increments.cover).parameters, reason="needs covers from given bounds")
def test_bounds_of_jacobians_make_a_proof_of_what_was_sampled():
    """As rigorous as they are, and said so; bounds that a sample contradicts are refused."""
    kink = shaped(
        lambda t, x, u, w, p: (-x[0] + x[1] + w[0], -x[1] - 0.1 * ca.fabs(x[1]) + w[1]),
        lambda t, x, u, w, p: x[0] + w[2],
    )
    found = certify_detectability(kink, eta=0.5, jacobians={"A": ([[-1, 1], [0, -1.1]], [[-1, 1], [0, -0.9]])})
    assert found.rigorous and "were given" in found.notes[0]
    with pytest.raises(InputError, match="outside the given bounds"):
        certify_detectability(kink, eta=0.5, jacobians={"A": ([[-1, 1], [0, -1.0]], [[-1, 1], [0, -0.9]])})


@pytest.mark.parametrize("gain", [1e3, 1e14])
def test_heavy_weights_hide_no_growth(gain):
    """A growing state that no output sees is refused whatever R is: rounding is measured row by row."""
    blind = shaped(lambda t, x, u, w, p: (-x[0] + w[0], 0.1 * x[1]), lambda t, x, u, w, p: x[0])
    with pytest.raises(CertificateError, match=r"eta = 0\.9"):
        certify_detectability(blind, eta=0.9, P=1.0, Q=10.0, R=gain)


@pytest.mark.parametrize("steep", [lambda b: 5 * ca.tanh(b - 350), lambda b: 1e-3 * ca.tanh(3e4 * (b - 0.31))])
def test_what_random_points_miss_is_seen_in_the_instructions(steep):
    """A step that is steep somewhere off the nominal values is no constant, and no proof is made of it."""
    hidden = shaped(lambda t, x, u, w, p: (-x[0] + w[0], -x[1] + steep(x[1])), lambda t, x, u, w, p: x[0])
    with pytest.raises(InputError, match="without finite bounds"):
        certify_detectability(hidden, Bounds(x={"a": (-1, 1)}), eta=0.7)
    with pytest.raises(CertificateError):
        certify_detectability(hidden, Bounds(x={"a": (-1, 1), "b": (-400, 400)}), eta=0.7)


def test_the_simplest_model_of_all():
    """Left to itself the rate of x' = -x + w, y = x + v is bounded by what noise may weigh, not by floating point."""
    model = ContinuousModel(
        lambda t, x, u, w, p: -x[0] + w[0], lambda t, x, u, w, p: x[0] + w[1], x="x", w=("w", "v"), y="y"
    )
    found = certify_detectability(model)
    assert found.rigorous and 0 < found.eta < 0.4 and found.margin >= 0
