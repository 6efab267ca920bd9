"""Plants from the papers and the literature, one function each that returns a `ContinuousModel`."""

from ctmhe.models.library.batch_reactor import batch_reactor
from ctmhe.models.library.cascaded_tanks import cascaded_tanks
from ctmhe.models.library.chua import chua, chua_discrete
from ctmhe.models.library.cstr import cstr, cstr_discrete, cstr_steady_states
from ctmhe.models.library.polytopes import (
    drifting_sine,
    sine_drift,
    sine_polytope,
    unknown_linear,
    unknown_linear_matrices,
)
from ctmhe.models.library.quadrotor import hover_speed, quadrotor, quadrotor_discrete
from ctmhe.models.library.random_stable import random_stable
from ctmhe.models.library.refilled_reactor import refill, refilled_reactor
from ctmhe.models.library.three_species import three_species, three_species_discrete
from ctmhe.models.library.van_der_pol import van_der_pol

__all__ = [
    "batch_reactor",
    "cascaded_tanks",
    "chua",
    "chua_discrete",
    "cstr",
    "cstr_discrete",
    "cstr_steady_states",
    "drifting_sine",
    "hover_speed",
    "quadrotor",
    "quadrotor_discrete",
    "random_stable",
    "refill",
    "refilled_reactor",
    "sine_drift",
    "sine_polytope",
    "three_species",
    "three_species_discrete",
    "unknown_linear",
    "unknown_linear_matrices",
    "van_der_pol",
]
