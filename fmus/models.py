"""All example models by name: the plants, then the traps."""

from __future__ import annotations

from fmus.plants import PLANTS
from fmus.traps import TRAPS
from fmus.variables import Description

MODELS: dict[str, Description] = {model.name: model for model in (*PLANTS, *TRAPS)}
"""Name -> description; `description.trap` is empty for a plant."""
