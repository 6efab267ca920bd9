"""Figures of runs and studies. Functions take data and Axes, return Axes, and never call `show`.

Okabe and Ito's colours, told apart by colour-blind readers; markers and line styles tell them apart in grey.
"""

from ctmhe.plotting.bounds import plot_bounds
from ctmhe.plotting.distributions import plot_gap_histogram, plot_solve_times
from ctmhe.plotting.runs import plot_gaps, plot_level, plot_output, plot_run, plot_state
from ctmhe.plotting.studies import plot_error_against_samples, plot_heatmap, plot_paired_differences, plot_pareto

__all__ = [
    "plot_bounds",
    "plot_error_against_samples",
    "plot_gap_histogram",
    "plot_gaps",
    "plot_heatmap",
    "plot_level",
    "plot_output",
    "plot_paired_differences",
    "plot_pareto",
    "plot_run",
    "plot_solve_times",
    "plot_state",
]
