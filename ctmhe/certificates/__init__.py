"""What is guaranteed, computed from a model and a domain: numbers for estimators and triggers.

Names are loaded when asked for: they need parts of SciPy that estimators do without.
"""

from importlib import import_module
from typing import Any

PLACES = {
    "DetectabilityCertificate": "certificate",
    "Guarantee": "guarantee",
    "certify_detectability": "detectability",
    "predict_growth": "growth",
}

__all__ = list(PLACES)


def __getattr__(name: str) -> Any:
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{PLACES[name]}"), name)
