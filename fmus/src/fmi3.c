/* FMI 3.0, model exchange and co-simulation, over core.h. Plants let their variables be set at any time. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "fmi3Functions.h"

typedef struct {
    Core core; /* first: a pointer to an instance is one to its core */
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Instance;

static fmi3Status report(Instance *m, fmi3Status level, const char *message) {
    if (m->log) m->log(m->environment, level, "logStatusError", message);
    return level;
}

static fmi3Status status_of(Instance *m, CoreStatus status) {
    if (status == CORE_OK) return fmi3OK;
    return report(m, core_can_be_mended(status) ? fmi3Discard : fmi3Error, core_message(status));
}

static fmi3Status none(fmi3Instance c, size_t n, const char *message) {
    return n == 0 ? fmi3OK : report(c, fmi3Error, message);
}

static const char *const no_type = "this FMU has no variables of this type";
static const char *const no_clocks = "this FMU has no clocks";

/* ---- common ---- */

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    return (void)c, (void)on, (void)n, (void)categories, fmi3OK;
}

static fmi3Instance instantiate(fmi3String token, int co_simulation, int event_mode, int early_return,
                                fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    Instance *m = calloc(1, sizeof *m);
    if (DEFECT_CRASHES_AT_LOAD) abort();
    if (!m) return NULL;
    m->environment = environment;
    m->log = log;
    if (!token || strcmp(token, MODEL_TOKEN) != 0) {
        report(m, fmi3Error, "the instantiation token does not belong to this binary: build the FMU again");
        free(m);
        return NULL;
    }
    if (status_of(m, core_open(&m->core, co_simulation, event_mode, early_return)) != fmi3OK) {
        free(m);
        return NULL;
    }
    return m;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    (void)name, (void)resources, (void)visible, (void)logging;
    return instantiate(token, 0, 0, 0, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode,
                                         fmi3Boolean early_return, const fmi3ValueReference intermediate[],
                                         size_t n_intermediate, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name, (void)resources, (void)visible, (void)logging;
    (void)intermediate, (void)n_intermediate, (void)update;
    return instantiate(token, 1, event_mode, early_return, environment, log);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)clock, (void)lock, (void)unlock;
    if (log) log(environment, fmi3Error, "logStatusError", "this FMU has no scheduled execution");
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c) {
    if (c) core_close(c);
    free(c);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    CoreStatus status = core_set_time(c, start);
    return status_of(c, status == CORE_OK ? core_enter(c, INITIALIZATION) : status);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return status_of(c, core_exit_initialization(c)); }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return status_of(c, core_enter(c, EVENT)); }
fmi3Status fmi3Terminate(fmi3Instance c) { return status_of(c, core_enter(c, TERMINATED)); }
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { return status_of(c, core_enter(c, CONFIGURATION)); }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { return status_of(c, core_enter(c, INSTANTIATED)); }

fmi3Status fmi3Reset(fmi3Instance c) {
    core_reset(c);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[],
                          size_t n_values) {
    return status_of(c, core_get(c, vr, n, values, n_values));
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 values[],
                          size_t n_values) {
    return status_of(c, core_set(c, vr, n, values, n_values));
}

#define NO_TYPE(Type)                                                                                         \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3##Type values[],    \
                             size_t n_values) {                                                               \
        return (void)vr, (void)values, (void)n_values, none(c, n, no_type);                                \
    }                                                                                                         \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n,                         \
                             const fmi3##Type values[], size_t n_values) {                                    \
        return (void)vr, (void)values, (void)n_values, none(c, n, no_type);                                \
    }
NO_TYPE(Float32)
NO_TYPE(Int8)
NO_TYPE(UInt8)
NO_TYPE(Int16)
NO_TYPE(UInt16)
NO_TYPE(Int32)
NO_TYPE(UInt32)
NO_TYPE(Int64)
NO_TYPE(Boolean)
NO_TYPE(String)

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary values[], size_t n_values) {
    return (void)vr, (void)sizes, (void)values, (void)n_values, none(c, n, no_type);
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                         const fmi3Binary values[], size_t n_values) {
    return (void)vr, (void)sizes, (void)values, (void)n_values, none(c, n, no_type);
}

/* Structural parameters are the only variables that are whole numbers. */
fmi3Status fmi3GetUInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 values[],
                         size_t n_values) {
    CoreStatus status = n == n_values ? CORE_OK : CORE_BAD_SIZE;
    for (size_t i = 0; i < n && status == CORE_OK; i++) {
        double value = 0.0;
        status = core_get_structural(c, vr[i], &value);
        values[i] = (fmi3UInt64)value;
    }
    return status_of(c, status);
}

fmi3Status fmi3SetUInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 values[],
                         size_t n_values) {
    CoreStatus status = n == n_values ? CORE_OK : CORE_BAD_SIZE;
    for (size_t i = 0; i < n && status == CORE_OK; i++) status = core_set_structural(c, vr[i], (double)values[i]);
    return status_of(c, status);
}

/* The dependencies are in the model description. */
fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t *n) {
    return (void)vr, (void)n, report(c, fmi3Error, "dependencies do not change: see modelDescription.xml");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent, size_t elements[],
                                       fmi3ValueReference independents[], size_t independent_elements[],
                                       fmi3DependencyKind kinds[], size_t n) {
    (void)dependent, (void)elements, (void)independents, (void)independent_elements, (void)kinds, (void)n;
    return report(c, fmi3Error, "dependencies do not change: see modelDescription.xml");
}

/* ---- state ---- */

#if SAVES_STATE

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    if (!*state) *state = malloc(sizeof(Values));
    if (!*state) return report(c, fmi3Error, "out of memory");
    return status_of(c, core_save(c, *state));
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    if (!state) return report(c, fmi3Error, "no FMU state was given");
    return status_of(c, core_load(c, state));
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    (void)c, (void)state;
    *size = sizeof(Values);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    if (size < sizeof(Values)) return report(c, fmi3Error, "the buffer is too small for the FMU state");
    memcpy(bytes, state, sizeof(Values));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    if (size != sizeof(Values)) return report(c, fmi3Error, "these bytes are not a state of this FMU");
    if (!*state) *state = malloc(sizeof(Values));
    if (!*state) return report(c, fmi3Error, "out of memory");
    memcpy(*state, bytes, sizeof(Values));
    return fmi3OK;
}

#else

static fmi3Status no_state(fmi3Instance c) { return status_of(c, CORE_NOT_OFFERED); }

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) { return (void)state, no_state(c); }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) { return (void)state, no_state(c); }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) { return (void)state, no_state(c); }
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    return (void)state, (void)size, no_state(c);
}
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    return (void)state, (void)bytes, (void)size, no_state(c);
}
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    return (void)bytes, (void)size, (void)state, no_state(c);
}

#endif

/* ---- derivatives ---- */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns,
                                        const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[],
                                        size_t n_sensitivity) {
    if (n_seed != n_knowns) return status_of(c, CORE_BAD_SIZE);
    return status_of(
        c, core_directional(c, unknowns, n_unknowns, knowns, n_knowns, seed, sensitivity, n_sensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                    const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                    size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity) {
    if (n_sensitivity != n_knowns) return status_of(c, CORE_BAD_SIZE);
    return status_of(c, core_adjoint(c, unknowns, n_unknowns, knowns, n_knowns, seed, n_seed, sensitivity));
}

/* ---- clocks: none ---- */

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock values[]) {
    return (void)vr, (void)values, none(c, n, no_clocks);
}
fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock values[]) {
    return (void)vr, (void)values, none(c, n, no_clocks);
}
fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[]) {
    return (void)vr, (void)intervals, (void)qualifiers, none(c, n, no_clocks);
}
fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]) {
    return (void)vr, (void)counters, (void)resolutions, (void)qualifiers, none(c, n, no_clocks);
}
fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 shifts[]) {
    return (void)vr, (void)shifts, none(c, n, no_clocks);
}
fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 counters[],
                                fmi3UInt64 resolutions[]) {
    return (void)vr, (void)counters, (void)resolutions, none(c, n, no_clocks);
}
fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                  const fmi3Float64 intervals[]) {
    return (void)vr, (void)intervals, none(c, n, no_clocks);
}
fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                   const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    return (void)vr, (void)counters, (void)resolutions, none(c, n, no_clocks);
}
fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 shifts[]) {
    return (void)vr, (void)shifts, none(c, n, no_clocks);
}
fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) {
    return (void)vr, (void)counters, (void)resolutions, none(c, n, no_clocks);
}
fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time) {
    return (void)clock, (void)time, report(c, fmi3Error, no_clocks);
}

/* ---- events ---- */

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) { return (void)c, fmi3OK; }

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals_changed, fmi3Boolean *states_changed,
                                    fmi3Boolean *next_event, fmi3Float64 *next_time) {
    EventReport event;
    CoreStatus status = core_event(c, &event);
    *again = *terminate = *nominals_changed = fmi3False; /* one round is enough for every model */
    *states_changed = event.states_changed != 0;
    *next_event = isfinite(event.next) != 0;
    *next_time = *next_event ? event.next : 0.0;
    return status_of(c, status);
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return status_of(c, core_enter(c, CONTINUOUS_TIME)); }
fmi3Status fmi3EnterStepMode(fmi3Instance c) { return status_of(c, core_enter(c, STEP)); }

/* ---- model exchange ---- */

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_rollback, fmi3Boolean *enter_event_mode,
                                       fmi3Boolean *terminate) {
    int enter;
    CoreStatus status = core_completed(c, &enter);
    (void)no_rollback;
    *enter_event_mode = enter != 0;
    *terminate = fmi3False;
    return status_of(c, status);
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) { return status_of(c, core_set_time(c, time)); }

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) {
    return status_of(c, core_set_states(c, x, n));
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) {
    return status_of(c, core_get_derivatives(c, dx, n));
}
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t n) {
    return status_of(c, core_get_indicators(c, indicators, n));
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    return status_of(c, core_get_states(c, x, n));
}
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t n) {
    return status_of(c, core_get_nominals(c, nominals, n));
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { return (void)c, *n = NZ, fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { return (void)c, *n = NX, fmi3OK; }

/* ---- co-simulation ---- */

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t n_values) {
    return (void)vr, (void)orders, (void)values, (void)n_values, none(c, n, "this FMU has no output derivatives");
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_rollback,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    StepReport end;
    CoreStatus status = core_step(c, t, h, &end);
    (void)no_rollback;
    *event = end.event != 0;
    *early = end.early != 0;
    *terminate = fmi3False;
    *last = end.time;
    return status_of(c, status);
}
