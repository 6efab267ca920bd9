"""What is guaranteed, computed from a model and a domain: numbers for estimators and triggers.

Names are loaded when asked for: most need parts of SciPy that estimators do without.
"""

from importlib import import_module
from typing import Any

_PLACES = {
    "certificate": ("DetectabilityCertificate",),
    "comparison": ("compare_horizons",),
    "detectability": ("certify_detectability",),
    "excitation": ("Direction", "ExcitationMonitor", "Information"),
    "excitation_design": ("design_excitation",),
    "excited_set": ("ExcitationDesign", "ExcitedSet"),
    "growth": ("Growth", "predict_growth"),
    "guarantee": ("Guarantee",),
    "joint": (
        "JointBound",
        "JointCertificate",
        "OnlineConditions",
        "certify_jointly",
        "joint_bound",
        "search_jointly",
        "uniform_excitation",
    ),
    "joint_bounds": ("JointGuarantee",),
    "metric": ("certify_metric",),
    "joint_horizons": ("joint_conditions", "joint_horizon"),
    "observers": ("design_observer",),
    "suboptimal_horizons": ("observer_horizon", "trajectory_horizon"),
    "weights": ("JointWeights", "StateDetectability", "detect_states", "joint_weights", "unmet"),
}
_MODULES = {name: module for module, names in _PLACES.items() for name in names}

__all__ = list(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
