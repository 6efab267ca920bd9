/* FMI 2.0, model exchange and co-simulation, over core.h. Variables are real; plants let them be set at any time. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "fmi2Functions.h"

typedef struct {
    Core core; /* first: a pointer to an instance is one to its core */
    fmi2CallbackFunctions callbacks;
    fmi2Boolean logging;
    char name[256];
} Instance;

static fmi2Status report(Instance *m, fmi2Status level, const char *message) {
    if (m->callbacks.logger)
        m->callbacks.logger(m->callbacks.componentEnvironment, m->name, level, "logStatusError", "%s", message);
    return level;
}

static fmi2Status status_of(Instance *m, CoreStatus status) {
    if (status == CORE_OK) return fmi2OK;
    return report(m, core_can_be_mended(status) ? fmi2Discard : fmi2Error, core_message(status));
}

static fmi2Status no_such_type(fmi2Component c, size_t n) {
    return n == 0 ? fmi2OK : report(c, fmi2Error, "this FMU has real variables only");
}

/* ---- common ---- */

#if DEFECT_CRASHES_AT_LOAD
__attribute__((constructor)) static void crash(void) { abort(); }
#endif

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    (void)n, (void)categories;
    ((Instance *)c)->logging = on;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    Instance *m = calloc(1, sizeof *m);
    (void)resources, (void)visible;
    if (!m) return NULL;
    if (callbacks) m->callbacks = *callbacks;
    m->logging = logging;
    if (name) strncpy(m->name, name, sizeof m->name - 1);
    if (!token || strcmp(token, MODEL_TOKEN) != 0) {
        report(m, fmi2Error, "the guid does not belong to this binary: build the FMU again");
        free(m);
        return NULL;
    }
    if (status_of(m, core_open(&m->core, type == fmi2CoSimulation, 0, 0)) != fmi2OK) {
        free(m);
        return NULL;
    }
    return m;
}

void fmi2FreeInstance(fmi2Component c) {
    if (c) core_close(c);
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean has_stop, fmi2Real stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    return status_of(c, core_set_time(c, start));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return status_of(c, core_enter(c, INITIALIZATION)); }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return status_of(c, core_exit_initialization(c)); }
fmi2Status fmi2Terminate(fmi2Component c) { return status_of(c, core_enter(c, TERMINATED)); }

fmi2Status fmi2Reset(fmi2Component c) {
    core_reset(c);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    return status_of(c, core_get(c, vr, n, value, n));
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    return status_of(c, core_set(c, vr, n, value, n));
}

#define NO_TYPE(Type)                                                                                              \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##Type value[]) {       \
        return (void)vr, (void)value, no_such_type(c, n);                                                         \
    }                                                                                                              \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##Type value[]) { \
        return (void)vr, (void)value, no_such_type(c, n);                                                         \
    }
NO_TYPE(Integer)
NO_TYPE(Boolean)
NO_TYPE(String)

/* ---- state ---- */

#if SAVES_STATE

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    if (!*state) *state = malloc(sizeof(Values));
    if (!*state) return report(c, fmi2Error, "out of memory");
    return status_of(c, core_save(c, *state));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    if (!state) return report(c, fmi2Error, "no FMU state was given");
    return status_of(c, core_load(c, state));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    (void)c, (void)state;
    *size = sizeof(Values);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    if (size < sizeof(Values)) return report(c, fmi2Error, "the buffer is too small for the FMU state");
    memcpy(bytes, state, sizeof(Values));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    if (size != sizeof(Values)) return report(c, fmi2Error, "these bytes are not a state of this FMU");
    if (!*state) *state = malloc(sizeof(Values));
    if (!*state) return report(c, fmi2Error, "out of memory");
    memcpy(*state, bytes, sizeof(Values));
    return fmi2OK;
}

#else

static fmi2Status no_state(fmi2Component c) { return status_of(c, CORE_NOT_OFFERED); }

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) { return (void)state, no_state(c); }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) { return (void)state, no_state(c); }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) { return (void)state, no_state(c); }
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    return (void)state, (void)size, no_state(c);
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    return (void)state, (void)bytes, (void)size, no_state(c);
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    return (void)bytes, (void)size, (void)state, no_state(c);
}

#endif

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[]) {
    return status_of(c, core_directional(c, unknowns, n_unknowns, knowns, n_knowns, seed, sensitivity, n_unknowns));
}

/* ---- model exchange ---- */

fmi2Status fmi2EnterEventMode(fmi2Component c) { return status_of(c, core_enter(c, EVENT)); }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return status_of(c, core_enter(c, CONTINUOUS_TIME)); }

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    EventReport event;
    CoreStatus status = core_event(c, &event);
    memset(info, 0, sizeof *info); /* one round is enough for every model, and none asks to end */
    info->valuesOfContinuousStatesChanged = event.states_changed;
    info->nextEventTimeDefined = isfinite(event.next);
    info->nextEventTime = info->nextEventTimeDefined ? event.next : 0.0;
    return status_of(c, status);
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_rollback, fmi2Boolean *enter_event_mode,
                                       fmi2Boolean *terminate) {
    (void)no_rollback;
    *terminate = fmi2False;
    return status_of(c, core_completed(c, enter_event_mode));
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { return status_of(c, core_set_time(c, time)); }

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    return status_of(c, core_set_states(c, x, n));
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    return status_of(c, core_get_derivatives(c, dx, n));
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t n) {
    return status_of(c, core_get_indicators(c, indicators, n));
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    return status_of(c, core_get_states(c, x, n));
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominals[], size_t n) {
    return status_of(c, core_get_nominals(c, nominals, n));
}

/* ---- co-simulation ---- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    (void)vr, (void)order, (void)value;
    return n == 0 ? fmi2OK : report(c, fmi2Error, "inputs are held over a step: no input derivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[]) {
    (void)vr, (void)order, (void)value;
    return n == 0 ? fmi2OK : report(c, fmi2Error, "this FMU has no output derivatives");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_rollback) {
    StepReport end;
    (void)no_rollback;
    return status_of(c, core_step(c, t, h, &end));
}

fmi2Status fmi2CancelStep(fmi2Component c) { return report(c, fmi2Error, "steps are not asynchronous"); }

#define NO_STATUS(Name, Type)                                                                         \
    fmi2Status fmi2Get##Name(fmi2Component c, const fmi2StatusKind kind, Type *value) {               \
        return (void)kind, (void)value, report(c, fmi2Discard, "steps are not asynchronous");         \
    }
NO_STATUS(Status, fmi2Status)
NO_STATUS(IntegerStatus, fmi2Integer)
NO_STATUS(BooleanStatus, fmi2Boolean)
NO_STATUS(StringStatus, fmi2String)

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    if (kind != fmi2LastSuccessfulTime) return report(c, fmi2Discard, "steps are not asynchronous");
    *value = ((Instance *)c)->core.values.v[VR_TIME];
    return fmi2OK;
}
