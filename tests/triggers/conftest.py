"""Shared settings of the tests of policies."""

from hypothesis import settings

settings.register_profile("no deadline", deadline=None)  # a busy machine is not a failing law
settings.load_profile("no deadline")
