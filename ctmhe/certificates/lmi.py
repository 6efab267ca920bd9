"""The one door to cvxpy: a semidefinite program goes in, its value comes out or a readable error."""

from __future__ import annotations

import warnings
from typing import Any

from ctmhe.errors import CertificateError, MissingExtra


def require_cvxpy() -> Any:
    """Return the module cvxpy, or raise `MissingExtra`."""
    try:
        import cvxpy
    except ImportError:
        raise MissingExtra("cvxpy", "certify", "computing certificates") from None
    return cvxpy


def solved(problem: Any) -> float:
    """Solve a cvxpy problem with Clarabel and return its optimal value; its variables then have values.

    Raises
    ------
    CertificateError
        If it is infeasible or unbounded, or the solver fails.
    """
    cp, value = require_cvxpy(), None
    for cut in (False, True):  # along their sparsity: most matrices here lose their interior by it, a few need it
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of inaccurate solutions: every matrix is verified again
                value = problem.solve(solver=cp.CLARABEL, chordal_decomposition_enable=cut)
            break
        except cp.SolverError:
            continue
    if value is None:
        raise CertificateError(
            "the semidefinite program could not be solved: it is infeasible or badly scaled. Try a slower rate, a "
            "smaller domain, or nominal= nearer to the sizes of the signals"
        )
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise CertificateError(f"the matrix inequality is {problem.status}; try a slower rate, or a smaller domain")
    return float(value)
