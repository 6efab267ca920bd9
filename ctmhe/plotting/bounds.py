"""A run's guaranteed bounds and its true error, in the norm of the certificate, beside the width of the domain."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.plotting.style import WIDTH, above_legend, ready

THEOREM, WINDOW, ERROR, DOMAIN = "#D55E00", "#0072B2", "#000000", "#999999"


def plot_bounds(dataset: Any, axes: Any = None) -> Any:
    """Draw the true error of every estimate and what was guaranteed of it, on a logarithmic axis.

    Parameters
    ----------
    dataset : xarray.Dataset
        `Run.dataset` of a run whose estimator had a guarantee.
    axes : Axes, optional
        Made when left out.

    Returns
    -------
    Axes

    Raises
    ------
    MissingExtra
        When matplotlib is not installed.
    InputError
        For a run without guarantee.
    """
    if "theorem_level" not in dataset:
        raise InputError("plot_bounds: the run's estimator had no certificate; build it with MHE(guarantee=...)")
    axes = ready(axes, (WIDTH, 3.4))
    t = dataset["solve_time"].to_numpy()
    n = dataset.sizes["state"]
    P = np.asarray(dataset.attrs["P_lower"], dtype=float).reshape(n, n)
    error = dataset["x_hat"].to_numpy() - dataset["x_true_solve"].to_numpy()
    if not np.isnan(error).any():
        size = np.sqrt(np.einsum("ki,ij,kj->k", error, P, error))
        axes.plot(t, size, color=ERROR, marker="o", markersize=2.5, linewidth=0.8, label="true error")
    for name, color, text in (("theorem_level", THEOREM, "Theorem 3.1"), ("window_level", WINDOW, "window's bound")):
        axes.plot(
            t, np.sqrt(dataset[name].to_numpy()), color=color, marker=".", markersize=4, linewidth=1.3, label=text
        )
    width = np.sqrt(float(dataset.attrs["domain_level"]))
    if np.isfinite(width):
        text = "width of the domain: above, no news"
        axes.axhline(width, color=DOMAIN, linewidth=1.0, linestyle=(0, (4, 2)), label=text)
    unmet = np.isnan(dataset["theorem_level"].to_numpy())
    if unmet.any():
        axes.vlines(
            t[unmet], 0, 0.05, transform=axes.get_xaxis_transform(), color="#CC79A7", linewidth=1.2, label="uncertified"
        )
    axes.set_yscale("log")
    if len(t):
        axes.set_xlim(float(dataset["time"][0]), float(dataset["time"][-1]))
    axes.set_ylabel("|error|$_P$")
    axes.set_xlabel("time [s]")
    above_legend(axes, columns=None)
    return axes
