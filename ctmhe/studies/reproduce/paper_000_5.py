"""Paper 000, section 5: joint estimation of the Chua circuit with conditions (33)-(34) checked online."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from ctmhe.certificates.excitation_design import design_excitation
from ctmhe.certificates.joint import JointCertificate, certify_jointly
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.priors.checked import CheckedPrior
from ctmhe.models.library import chua_discrete
from ctmhe.studies.reproduce.joint_runs import over_seeds, summary, track
from ctmhe.types import Bounds

TRUTH, P_TRUE, GUESS = [2.0, 0.1, -2.0], [0.45], np.array([0.0, 0.0, 0.0, 0.2])
SIZES = np.array([1e-3, 1e-3, 1e-3, 0.1])
LAMBDA, KAPPA, HORIZON, STEPS = 0.911, 1e7, 200, 1000
S_0, ALPHA = 1e-3, 1e-6
ITERATIONS = 60
WEAK = (400, 600)


@cache
def scheme(size: float = 1.0) -> tuple[MHE, JointCertificate]:
    """Return the estimator for disturbances of `size` times the printed ones, and its certificate."""
    model = chua_discrete()
    x = {**model.bounds.x, "x1": (-5.0, 5.0)}  # type: ignore[dict-item]
    domain = Bounds(x=x, w=model.bounds.w, p=model.bounds.p)
    joint = certify_jointly(design_excitation(model, domain, mu=LAMBDA), alpha=ALPHA, S_0=[[S_0]])
    largest = dict(zip(model.w.names, size * SIZES, strict=True))
    prior = CheckedPrior(joint, kappa=KAPPA, disturbance=largest)
    horizon = HORIZON * float(model.step or 1.0)
    settings: dict[str, Any] = {"cost": joint.cost(), "bounds": domain, "prior": prior, "max_iterations": ITERATIONS}
    return MHE(model, horizon=horizon, **settings), joint


def one_seed(seed: int, *, steps: int = STEPS, size: float = 1.0) -> dict[str, Any]:
    """Return errors, conditions and bounds of one run."""
    mhe, _ = scheme(size)
    w = np.random.default_rng(seed).uniform(-1, 1, (steps, 4)) * SIZES * size
    truth, runs = track(mhe.model, {"MHE": mhe}, truth=np.array(TRUTH), guess=GUESS, w=w, p=np.array(P_TRUE))
    run = runs["MHE"]
    error = run["estimates"] - np.column_stack([truth, np.full(len(truth), P_TRUE[0])])
    notes = [note for result in run["results"] for note in result["notes"]]
    ratios, radii, wide = [], [], []
    for e, result in zip(error[1:], run["results"], strict=True):
        level, theorem, cap, M = result["bound"]
        known = [value for value in (level, theorem) if value is not None]
        if known:
            ratios.append(float(e @ M @ e) / min(known))
            radii.append(float(np.sqrt(min(known) * np.linalg.inv(M)[-1, -1])))
            wide.append(min(known) >= cap * (1 - 1e-9))
    first, last = WEAK
    size_of = np.linalg.norm(error, axis=1)
    settled = slice(min(HORIZON // 2, len(size_of) - 1), None)
    return {
        "normalised": float(size_of[settled].mean() / size_of[0]),
        "e_p": float(np.sqrt(np.mean(error[settled, 3] ** 2))),
        "weak": float(np.abs(error[first:last, 3]).mean()) if steps >= last else float("nan"),
        "elsewhere": float(np.abs(np.append(error[HORIZON:first, 3], error[last:, 3])).mean())
        if steps >= last
        else float("nan"),
        "violated": sum(note.startswith("(33)") for note in notes),
        "unexcited": sum(note.startswith("(34)") for note in notes),
        "ratio": max(ratios, default=float("nan")),
        "radius": float(np.median(radii)) if radii else float("nan"),
        "wide": float(np.mean(wide)) if wide else float("nan"),
        "failures": sum(not result["success"] for result in run["results"]),
        "seconds": run["seconds"],
    }


def reproduce(
    *, seeds: int = 3, workers: int = 1, progress: bool = False, steps: int = STEPS, **_: Any
) -> dict[str, Any]:
    """Run the scheme with the printed noise, and with a thousandth of it, where its bound (9) says something.

    Parameters
    ----------
    seeds : int
        Of disturbances.
    workers : int
        Processes.
    progress : bool
        Show a progress bar.
    steps : int
        1000, as in the figure.

    Returns
    -------
    dict with `published`, `ours`, `settings`, `comment`
    """
    loud, quiet = (
        over_seeds(partial(one_seed, steps=steps, size=size), seeds, workers=workers, progress=progress)
        for size in (1.0, 1e-3)
    )
    joint = scheme()[1]
    contraction = 4 * KAPPA * LAMBDA**HORIZON
    return {
        "case": "paper000-5",
        "published": {
            "4 kappa lambda^N below one": True,
            "(33) holds in all steps": True,
            "(34) holds in all steps": True,
            "e_p is larger in [400, 600]": True,
        },
        "ours": {
            "4 kappa lambda^N below one": contraction < 1,
            "(33) holds in all steps": all(run["violated"] == 0 for run in loud),
            "(34) holds in all steps": all(run["unexcited"] == 0 for run in loud),
            "e_p is larger in [400, 600]": bool(
                np.mean([run["weak"] for run in loud]) > 2 * np.mean([run["elsewhere"] for run in loud])
            ),
            "4 kappa lambda^N": contraction,
            "steps_without_(34)": summary([run["unexcited"] for run in loud]),
            "mean |e_p| in [400, 600]": summary([run["weak"] for run in loud]),
            "mean |e_p| elsewhere": summary([run["elsewhere"] for run in loud]),
            "|e| over |e(0)|, settled": summary([run["normalised"] for run in loud]),
            "RMSE(e_p), settled": summary([run["e_p"] for run in loud]),
            "tau_avg [ms]": summary([1e3 * run["seconds"] for run in loud]),
            "largest_error_over_bound": max(run["ratio"] for run in (*loud, *quiet)),
            "share_of_bounds_as_wide_as_the_domain": {
                "printed noise": float(np.mean([run["wide"] for run in loud])),
                "a thousandth of it": float(np.mean([run["wide"] for run in quiet])),
            },
            "with a thousandth of the noise": {
                "RMSE(e_p), settled": summary([run["e_p"] for run in quiet]),
                "median guaranteed radius of p": summary([run["radius"] for run in quiet]),
                "(34) holds in all steps": all(run["unexcited"] == 0 for run in quiet),
            },
            "solves_stopped_at_the_limit": float(np.mean([run["failures"] for run in loud])) / steps,
        },
        "settings": {
            "seeds": seeds,
            "steps": steps,
            "N": HORIZON,
            "lambda": LAMBDA,
            "kappa": KAPPA,
            "most_iterations": ITERATIONS,
            "S_0": S_0,
            "alpha": ALPHA,
            "P, L, Q, R": "our own design at lambda = 0.911 on |x1| <= 5",
            "kappa_of_the_certificate": joint.kappa,
            "disturbances": "bounded to their set",
            "guess": GUESS.tolist(),
        },
        "comment": COMMENT,
    }


COMMENT = (
    "The paper shows one run in a figure, without numbers. P, Q, R, a and S_0 are not printed: ours come from one "
    "program at lambda = 0.911 (a = 1, no epsilons); S_0 = 1e-3 and alpha = 1e-6 are chosen, and S_0 hardly matters: "
    "lambda^N = 8e-9. (33) with kappa = 1e7 holds throughout. (34) depends on the alpha, which is not printed either: "
    "in the rest near x1 = 0 after the first convergence, of which the paper speaks, the level falls by five decades, "
    "and the parameter may be anywhere in its box. There many solves do not converge, a sixth of all; they are stopped "
    "after 60 iterations. With noise of 0.1 the bound (9) is as wide as the domain; at a thousandth of it it is not."
)
