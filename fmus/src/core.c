/* Values, modes, events and directional derivatives: see core.h. */
#include "core.h"

#include <math.h>
#include <string.h>

#if DEFECT_FAILS
#include "fails.h"
#endif

static const double x_start[] = X_START, u_start[] = U_START, p_start[] = P_START, q_start[] = Q_START;

const char *core_message(CoreStatus status) {
    switch (status) {
    case CORE_OK: return "ok";
    case CORE_BAD_REFERENCE: return "a value reference is unknown, or has no derivative in this role";
    case CORE_BAD_SIZE: return "the number of values does not fit the variables, states or event indicators";
    case CORE_NOT_SETTABLE: return "only states, inputs and parameters can be set";
    case CORE_WRONG_MODE: return "this cannot be set in this mode";
    case CORE_NOT_OFFERED: return "the model description does not offer this";
    case CORE_SECOND_INSTANCE: return "there is an instance already, and this FMU allows one in a process";
    case CORE_WRONG_STEP: return "the communication step must have the length of the default experiment's stepSize";
    case CORE_NOT_FINITE: return "the integration left the finite numbers, or its step size vanished";
    case CORE_DISCARDED: return "the model cannot be evaluated there";
    case CORE_BROKEN: return "an error happened: this instance can only be reset or freed";
    }
    return "unknown";
}

int core_can_be_mended(CoreStatus status) { return status == CORE_NOT_FINITE || status == CORE_DISCARDED; }

/* ---- life ---- */

#if SINGLE_INSTANCE
static int instances = 0;
#endif

CoreStatus core_open(Core *core, int co_simulation, int event_mode, int early_return) {
    if (co_simulation ? !CO_SIMULATION : !MODEL_EXCHANGE) return CORE_NOT_OFFERED;
#if SINGLE_INSTANCE
    if (instances > 0) return CORE_SECOND_INSTANCE;
    instances++;
#endif
    core->co_simulation = co_simulation;
    core->event_mode = co_simulation && event_mode;
    core->early_return = early_return;
    core_reset(core);
    return CORE_OK;
}

void core_close(Core *core) {
    (void)core;
#if SINGLE_INSTANCE
    instances--;
#endif
}

void core_reset(Core *core) {
    Values *values = &core->values;
    memset(values, 0, sizeof *values);
    memcpy(values->v + VR_X, x_start, NX * sizeof(double));
    memcpy(values->v + VR_U, u_start, NU * sizeof(double));
    memcpy(values->v + VR_P, p_start, NP * sizeof(double));
    memcpy(values->v + VR_Q, q_start, NQ * sizeof(double));
    values->next_event = INFINITY;
    values->mode = INSTANTIATED;
    values->stale = 1;
    core->broken = 0;
}

CoreStatus core_enter(Core *core, Mode mode) {
    if (core->broken) return CORE_BROKEN;
    core->values.mode = mode;
    return CORE_OK;
}

CoreStatus core_exit_initialization(Core *core) {
    EventReport report;
    if (core->broken) return CORE_BROKEN;
    core->values.mode = core->co_simulation && !core->event_mode ? STEP : EVENT;
    return core->values.mode == STEP ? core_event(core, &report) : CORE_OK;
}

/* ---- values ---- */

CoreStatus core_evaluate(Core *core, const double x[], double dx[], double y[]) {
    const double *v = core->values.v;
    model_evaluate(x, v + VR_U, v + VR_P, v + VR_Q, dx, y);
#if DEFECT_FAILS
    return fail(core, x, dx);
#else
    return CORE_OK;
#endif
}

static CoreStatus refresh(Core *core) {
    double *v = core->values.v;
    if (!core->values.stale) return CORE_OK;
    CoreStatus status = core_evaluate(core, v + VR_X, v + VR_DX, v + VR_Y);
    if (status == CORE_OK) core->values.stale = 0;
    return status;
}

static int is_calculated(unsigned int vr) { return (vr >= VR_DX && vr < VR_U) || (vr >= VR_Y && vr < VR_Q); }

static int is_settable(unsigned int vr) { return (vr >= VR_X && vr < VR_DX) || (vr >= VR_U && vr < VR_Y); }

static int is_parameter(unsigned int vr) { return vr >= VR_P && vr < VR_Y; }

/* Number of scalars of a variable, 0 when there is none: the other entries of an array and a structural parameter,
 * which is no Float64, cannot be named. */
static size_t size_of(unsigned int vr) {
    if (vr >= N_VALUES - STRUCTURAL || (vr > VR_Y + ARRAY_Y && vr < VR_Y + ARRAY_Y + ARRAY_SIZE)) return 0;
    return vr == VR_Y + ARRAY_Y ? ARRAY_SIZE : 1;
}

static CoreStatus check_sizes(const unsigned int vr[], size_t n, size_t n_values) {
    size_t total = 0;
    for (size_t i = 0; i < n; i++) {
        if (size_of(vr[i]) == 0) return CORE_BAD_REFERENCE;
        total += size_of(vr[i]);
    }
    return total == n_values ? CORE_OK : CORE_BAD_SIZE;
}

CoreStatus core_get(Core *core, const unsigned int vr[], size_t n, double out[], size_t n_out) {
    CoreStatus status = core->broken ? CORE_BROKEN : check_sizes(vr, n, n_out);
    for (size_t i = 0; i < n && status == CORE_OK; i++) {
        if (is_calculated(vr[i])) status = refresh(core);
        memcpy(out, core->values.v + vr[i], size_of(vr[i]) * sizeof(double));
        out += size_of(vr[i]);
    }
    return status;
}

CoreStatus core_set(Core *core, const unsigned int vr[], size_t n, const double in[], size_t n_in) {
    Values *values = &core->values;
    CoreStatus status = core->broken ? CORE_BROKEN : check_sizes(vr, n, n_in);
    if (status != CORE_OK) return status;
    int initializing = values->mode == INSTANTIATED || values->mode == INITIALIZATION;
    for (size_t i = 0; i < n; i++) {
        if (!is_settable(vr[i])) return CORE_NOT_SETTABLE;
        if (FIXED_PARAMETERS && is_parameter(vr[i]) && !initializing) return CORE_WRONG_MODE;
        if (DEFECT_STRICT_PARAMETERS && is_parameter(vr[i]) && values->mode == CONTINUOUS_TIME) return CORE_WRONG_MODE;
    }
    for (size_t i = 0; i < n; i++) values->v[vr[i]] = in[i];
    /* the trap `stale`: after the initialization nothing is evaluated anew for values that are set one by one */
    if (!DEFECT_STALE || initializing) values->stale = 1;
    return CORE_OK;
}

CoreStatus core_get_structural(Core *core, unsigned int vr, double *out) {
    if (core->broken) return CORE_BROKEN;
    if (!STRUCTURAL || vr != N_VALUES - 1) return CORE_BAD_REFERENCE;
    *out = core->values.v[vr];
    return CORE_OK;
}

CoreStatus core_set_structural(Core *core, unsigned int vr, double in) {
    if (core->broken) return CORE_BROKEN;
    if (!STRUCTURAL || vr != N_VALUES - 1) return CORE_BAD_REFERENCE;
    if (core->values.mode != CONFIGURATION) return CORE_WRONG_MODE;
    core->values.v[vr] = in;
    core->values.stale = 1;
    return CORE_OK;
}

CoreStatus core_set_time(Core *core, double t) {
    if (core->broken) return CORE_BROKEN;
    core->values.v[VR_TIME] = t;
    return CORE_OK;
}

static CoreStatus check_count(const Core *core, size_t n, size_t expected) {
    return core->broken ? CORE_BROKEN : n == expected ? CORE_OK : CORE_BAD_SIZE;
}

CoreStatus core_get_states(Core *core, double x[], size_t n) {
    CoreStatus status = check_count(core, n, NX);
    if (status == CORE_OK) memcpy(x, core->values.v + VR_X, NX * sizeof(double));
    return status;
}

CoreStatus core_set_states(Core *core, const double x[], size_t n) {
    CoreStatus status = check_count(core, n, NX);
    if (status != CORE_OK) return status;
    memcpy(core->values.v + VR_X, x, NX * sizeof(double));
    core->values.stale = 1;
    return CORE_OK;
}

CoreStatus core_get_nominals(Core *core, double nominals[], size_t n) {
    static const double x_nominal[] = X_NOMINAL;
    CoreStatus status = check_count(core, n, NX);
    if (status == CORE_OK) memcpy(nominals, x_nominal, NX * sizeof(double));
    return status;
}

CoreStatus core_get_derivatives(Core *core, double dx[], size_t n) {
    CoreStatus status = check_count(core, n, NX);
    if (status == CORE_OK) status = refresh(core);
    if (status == CORE_OK) memcpy(dx, core->values.v + VR_DX, NX * sizeof(double));
    return status;
}

CoreStatus core_get_indicators(Core *core, double z[], size_t n) {
    CoreStatus status = check_count(core, n, NZ);
    if (status == CORE_OK && n > 0) status = refresh(core);
    if (status == CORE_OK) memcpy(z, core->values.v + VR_Z, NZ * sizeof(double));
    return status;
}

CoreStatus core_save(Core *core, Values *copy) {
    if (core->broken) return CORE_BROKEN;
    *copy = core->values;
    return CORE_OK;
}

CoreStatus core_load(Core *core, const Values *copy) {
    if (core->broken) return CORE_BROKEN;
    core->values = *copy;
    return CORE_OK;
}

/* ---- events ---- */

CoreStatus core_event(Core *core, EventReport *report) {
    report->states_changed = 0;
    report->next = INFINITY;
    if (core->broken) return CORE_BROKEN;
#if HAS_EVENTS
    double *v = core->values.v;
    report->states_changed =
        model_event(v[VR_TIME], v + VR_X, v + VR_U, v + VR_P, v + VR_Q, &report->next);
    core->values.next_event = report->next;
    core->values.stale = 1;
#endif
    return CORE_OK;
}

CoreStatus core_completed(Core *core, int *enter_event_mode) {
    *enter_event_mode = 0;
    if (core->broken) return CORE_BROKEN;
#if COMPLETED_STEPS
    *enter_event_mode = model_completed(core->values.v + VR_Q);
#endif
    return CORE_OK;
}

/* ---- derivatives ---- */

void core_tangent(const Values *values, const double seed[N_VALUES], double result[N_VALUES]) {
    const double *v = values->v;
    memcpy(result, seed, N_VALUES * sizeof(double));
    model_tangent(v + VR_X, v + VR_U, v + VR_P, v + VR_Q, seed + VR_X, seed + VR_U, seed + VR_P, result + VR_DX,
                  result + VR_Y);
}

static int is_known(unsigned int vr) { /* no model depends on time, so its derivative is zero */
    return vr < VR_DX || (vr >= VR_U && vr < VR_Y);
}

/* Whether directional derivatives are offered and can be taken here, of these variables. */
static CoreStatus check(Core *core, const unsigned int unknowns[], size_t n_unknowns, size_t n_scalars,
                        const unsigned int knowns[], size_t n_knowns) {
    if (core->broken) return CORE_BROKEN;
    if (!DIRECTIONAL_DERIVATIVES) return CORE_NOT_OFFERED;
    for (size_t i = 0; i < n_knowns; i++)
        if (!is_known(knowns[i])) return CORE_BAD_REFERENCE;
    CoreStatus status = check_sizes(unknowns, n_unknowns, n_scalars);
#if DEFECT_FAILS
    double dx[NX];
    if (status == CORE_OK) status = fail(core, core->values.v + VR_X, dx);
#endif
    return status;
}

CoreStatus core_directional(Core *core, const unsigned int unknowns[], size_t n_unknowns, const unsigned int knowns[],
                            size_t n_knowns, const double seed[], double sensitivity[], size_t n_sensitivity) {
    double s[N_VALUES] = {0}, result[N_VALUES];
    CoreStatus status = check(core, unknowns, n_unknowns, n_sensitivity, knowns, n_knowns);
    if (status != CORE_OK) return status;
    for (size_t i = 0; i < n_knowns; i++) s[knowns[i]] += seed[i];
    core_tangent(&core->values, s, result);
    for (size_t i = 0; i < n_unknowns; sensitivity += size_of(unknowns[i]), i++)
        memcpy(sensitivity, result + unknowns[i], size_of(unknowns[i]) * sizeof(double));
    return CORE_OK;
}

CoreStatus core_adjoint(Core *core, const unsigned int unknowns[], size_t n_unknowns, const unsigned int knowns[],
                        size_t n_knowns, const double seed[], size_t n_seed, double sensitivity[]) {
    CoreStatus status = check(core, unknowns, n_unknowns, n_seed, knowns, n_knowns);
    if (status != CORE_OK) return status;
    for (size_t j = 0; j < n_knowns; j++) {
        double s[N_VALUES] = {0}, result[N_VALUES];
        const double *next = seed;
        s[knowns[j]] = 1.0;
        core_tangent(&core->values, s, result);
        sensitivity[j] = 0.0;
        for (size_t i = 0; i < n_unknowns; i++)
            for (size_t k = 0; k < size_of(unknowns[i]); k++) sensitivity[j] += *next++ * result[unknowns[i] + k];
    }
    return CORE_OK;
}
