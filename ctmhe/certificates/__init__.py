"""What is guaranteed, computed from a model and a domain: numbers for estimators and triggers."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ctmhe.certificates.certificate import DetectabilityCertificate
    from ctmhe.certificates.detectability import certify_detectability

HOMES = {"DetectabilityCertificate": "certificate", "certify_detectability": "detectability"}
"""Where public names live: imported when they are asked for, since most runs need none of them."""

__all__ = ["DetectabilityCertificate", "certify_detectability"]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{HOMES[name]}"), name)
