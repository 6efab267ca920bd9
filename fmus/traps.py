"""The traps: one pendulum, and in each FMU one thing that an importer has to notice.

What the model description does not tell is a `defect`; the C sources act on it.
"""

from __future__ import annotations

from dataclasses import replace

from fmus.plants import PENDULUM
from fmus.variables import CO_SIMULATION, DEFECTS, MODEL_EXCHANGE, Description, Variable

_ANGLE, _RATE = PENDULUM.states


def _trap(name: str, trap: str, **changes: object) -> Description:
    defect = name if name in DEFECTS else ""
    return replace(PENDULUM, name=name, source="pendulum", trap=trap, defect=defect, **changes)


_DEPENDENCIES = (
    _trap(
        "wrong_dependencies",
        "der(rate) depends on angle and c, which its dependencies leave out; directional derivatives are right",
        states=(_ANGLE, replace(_RATE, depends=("rate", "torque", "k"))),
    ),
    _trap(
        "no_dependencies",
        "no unknown declares dependencies, so each depends on everything",
        dependencies=False,
    ),
)

_DERIVATIVES = (
    _trap(
        "no_derivatives",
        "there are no directional derivatives: the function fails when it is called",
        directional_derivatives=False,
    ),
    _trap("wrong_derivatives", "the directional derivative of der(rate) with respect to angle has the wrong sign"),
    _trap(
        "stale",
        "what is read after setReal or setFloat64 is the value from before, until setContinuousStates or a step",
    ),
)

_PARAMETERS = (
    _trap(
        "fixed_parameters",
        "parameters are fixed: setting them after the initialization is an error",
        variability="fixed",
    ),
    _trap(
        "strict_parameters",
        "parameters are tunable, but setting them in continuous-time mode is an error",
    ),
)

_FAILURES = (
    _trap(
        "fails",
        "evaluating with angle above `limit` fails as `failure` says: 0 not, 1 discard, 2 error, there and in every "
        "later call, 3 der(rate) is not a number, 4 the process is aborted, 5 it hangs",
        parameters=(
            *PENDULUM.parameters,
            Variable("limit", "rad", 1.0, 1.0, "largest angle that can be evaluated"),
            Variable("failure", "1", 0.0, 1.0, "what happens beyond: 0 nothing, 1 to 5 a failure"),
        ),
    ),
    _trap(
        "crashes_at_load",
        "the process is aborted when the library is loaded (FMI 2) or when an instance is made (FMI 3)",
    ),
    _trap(
        "single_instance",
        "a second instance in the same process is refused, as canBeInstantiatedOnlyOncePerProcess says",
        single_instance=True,
    ),
)

_CO_SIMULATION = (
    _trap(
        "co_simulation_only",
        "there is no model exchange; the states are known and can be set",
        kinds=(CO_SIMULATION,),
    ),
    _trap(
        "no_saving",
        "co-simulation only, and the FMU state can neither be got nor set",
        kinds=(CO_SIMULATION,),
        saves_state=False,
    ),
    _trap(
        "fixed_step",
        "co-simulation only, and a communication step of any length but the default stepSize is an error",
        kinds=(CO_SIMULATION,),
        variable_step=False,
    ),
)

_VARIABLES = (
    _trap(
        "zero_nominal",
        "the nominal value of the state angle is 0, so tolerances scaled by it are 0 too",
        states=(replace(_ANGLE, nominal=0.0, rate=1.0), _RATE),
    ),
    _trap(
        "completed_step",
        "every tenth completed integrator step asks for an event, where the discrete variable load grows; it enters "
        "der(rate), so that an importer who does not report its steps gets another motion",
        kinds=(MODEL_EXCHANGE,),
        completed_steps=True,
        discretes=(
            Variable("load", "rad/s2", 0.0, 1.0, "torque subtracted from the input; grows by 0.1 an event"),
            Variable("steps", "1", 0.0, 10.0, "number of completed steps since the last event"),
        ),
    ),
    _trap(
        "arrays",
        "an output is an array of two entries (FMI 3 only)",
        versions=(3,),
        outputs=(
            *PENDULUM.outputs,
            Variable("motion", "1", None, 1.0, "angle [rad] and rate [rad/s]", ("angle", "rate"), size=2),
        ),
    ),
    _trap(
        "structural",
        "a structural parameter multiplies the damping (FMI 3 only); it can be set in configuration mode",
        versions=(3,),
        structural=Variable("dampers", "1", 1.0, 1.0, "number of dampers"),
    ),
)

TRAPS = (*_DEPENDENCIES, *_DERIVATIVES, *_PARAMETERS, *_FAILURES, *_CO_SIMULATION, *_VARIABLES)
