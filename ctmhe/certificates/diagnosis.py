"""Why a model has no certificate, and where its domain is left: what a solver's status does not say."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctmhe.certificates.increments import Increments
from ctmhe.certificates.injection import Units
from ctmhe.types import Array

SAMPLES = 200


def combination(names: tuple[str, ...], vector: Array) -> str:
    """Return `0.71 pA - 0.71 pB`, without what is small."""
    vector = vector / np.linalg.norm(vector)
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    parts = [(value, name) for value, name in zip(vector, names, strict=True) if abs(value) > 5e-3]
    text = " ".join(f"{'-' if value < 0 else '+'} {abs(value):.2g} {name}" for value, name in parts)
    return text.removeprefix("+ ")


def point(increments: Increments, v: Array, where: Array | None = None) -> str:
    """Return `pA = 0.1, pB = 2`: entries of a point on which something depends."""
    shown = increments.varying if where is None else where
    return ", ".join(f"{increments.names[i]} = {v[i]:.4g}" for i in shown) or "any point"


def unseen_mode(increments: Increments, eta: float) -> str | None:
    """Return a sentence on a mode of a linearisation that outputs do not see and that fades more slowly than eta.

    The test of Popov, Belevitch and Hautus at points of the domain: for an eigenvalue s of A whose mode is to be seen,
    [A - s I; C] has full rank. Where it has not, no P meets the inequality, whatever Q and R.
    """
    units = Units.of(increments.model)
    v = np.vstack([increments.centre, increments.corners(), increments.random(SAMPLES, np.random.default_rng(0))])
    jacobians = units.scaled(increments.at(v))
    best: tuple[float, int, complex, Array] | None = None
    for k, (A, C) in enumerate(zip(jacobians.A, jacobians.C, strict=True)):
        size = max(np.linalg.norm(A, 2), 1e-300)
        seen = C / max(np.linalg.norm(C, 2), 1e-300)
        for s in np.linalg.eigvals(A):
            fades = abs(s) ** 2 < eta * (1 - 1e-9) if units.discrete else 2 * s.real < np.log(eta) - 1e-9 * size
            if fades or s.imag < 0:
                continue
            _, values, modes = np.linalg.svd(np.vstack([(A - s * np.eye(len(A))) / size, seen]))
            if best is None or values[-1] < best[0] * 0.99:
                best = (float(values[-1]), k, s, modes[-1].conj())
    if best is None or best[0] > 1e-7:
        return None
    _, k, s, mode = best
    mode = mode * np.exp(-1j * np.angle(mode[np.argmax(np.abs(mode))]))
    directions = combination(increments.model.x.names, mode.real)
    if np.linalg.norm(mode.imag) > 1e-6:
        directions += " and " + combination(increments.model.x.names, mode.imag)
    pace = f"is multiplied by {abs(s):.4g} a step" if units.discrete else f"changes by exp({s.real:.4g} t)"
    return (
        f"at {point(increments, v[k])} outputs do not see the direction {directions} (in nominal units), which {pace}"
    )


def leaving(increments: Increments) -> tuple[str, ...]:
    """Return notes on faces of the domain of x through which trajectories leave it; sampled, none is no proof."""
    model, place, rng = increments.model, increments.place["x"], np.random.default_rng(1)
    lower, upper = increments.lower[place], increments.upper[place]
    function, found = model.dynamics, []
    for i, name in enumerate(model.x.names):
        for side, sign in ((lower[i], -1.0), (upper[i], 1.0)):
            if not np.isfinite(side):
                continue
            v = increments.random(SAMPLES, rng)
            v[:, place.start + i] = side
            groups = [v[:, increments.place[key]].T for key in "xuwp"]
            f = np.asarray(ca.DM(function(0.0, *map(ca.DM, groups))))[i]
            out = sign * (f - side) if model.step else sign * f
            worst = int(np.argmax(out))
            if out[worst] > 1e-9 * model.x.nominal[i]:
                found.append(f"{name} = {side:.4g}")
    if not found:
        return ()
    return (
        f"the domain is not invariant: trajectories can leave it through {', '.join(found)}; what is certified is "
        "certified of pairs of trajectories while they stay inside",
    )
