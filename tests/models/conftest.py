"""Hypothesis without deadlines: a busy machine is not a failing law."""

from hypothesis import settings

settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")
