/* The part of an FMU that does not depend on the FMI version: values, modes, events, derivatives, co-simulation. */
#ifndef CTMHE_CORE_H
#define CTMHE_CORE_H

#include <stddef.h>

#include "model.h"

/* Value references: 0 is time, then states, their derivatives, inputs, parameters, outputs with event indicators,
 * and discrete variables, in this order. */
enum {
    VR_TIME = 0,
    VR_X = 1,
    VR_DX = VR_X + NX,
    VR_U = VR_DX + NX,
    VR_P = VR_U + NU,
    VR_Y = VR_P + NP,
    VR_Z = VR_Y + NY - NZ,
    VR_Q = VR_Y + NY,
    N_VALUES = VR_Q + NQ
};

typedef enum { CONFIGURATION, INSTANTIATED, INITIALIZATION, EVENT, CONTINUOUS_TIME, STEP, TERMINATED } Mode;

/* Everything that an FMU state holds: plain data, so that a copy is a checkpoint. */
typedef struct {
    double v[N_VALUES]; /* by value reference */
    double step;        /* step size that the error control proposes next, 0 when unknown */
    double next_event;  /* time of the next planned event, infinite when none is */
    Mode mode;
    int stale; /* derivatives and outputs wait for an evaluation */
} Values;

/* An instance, but for what a version of FMI adds. */
typedef struct {
    Values values;
    int co_simulation;
    int event_mode;   /* the importer of the co-simulation handles events ... */
    int early_return; /* ... at which a step may end */
    int broken;       /* an error came before: nothing works any more */
} Core;

typedef enum {
    CORE_OK,
    CORE_BAD_REFERENCE,
    CORE_BAD_SIZE,
    CORE_NOT_SETTABLE,
    CORE_WRONG_MODE,
    CORE_NOT_OFFERED,
    CORE_SECOND_INSTANCE,
    CORE_WRONG_STEP,
    CORE_NOT_FINITE, /* this and the next can be mended by other values */
    CORE_DISCARDED,
    CORE_BROKEN
} CoreStatus;

typedef struct {
    int states_changed;
    double next; /* time of the next planned event, infinite when none is */
} EventReport;

typedef struct {
    double time; /* where the step ended */
    int event;   /* whether the importer has to handle one there */
    int early;   /* whether that is before the end it was given */
} StepReport;

const char *core_message(CoreStatus status);
int core_can_be_mended(CoreStatus status);

/* Begin and end of an instance. */
CoreStatus core_open(Core *core, int co_simulation, int event_mode, int early_return);
void core_close(Core *core);
void core_reset(Core *core);

CoreStatus core_enter(Core *core, Mode mode);
CoreStatus core_exit_initialization(Core *core);

/* `n_out` counts scalars: an array has several. */
CoreStatus core_get(Core *core, const unsigned int vr[], size_t n, double out[], size_t n_out);
CoreStatus core_set(Core *core, const unsigned int vr[], size_t n, const double in[], size_t n_in);
CoreStatus core_get_structural(Core *core, unsigned int vr, double *out);
CoreStatus core_set_structural(Core *core, unsigned int vr, double in);
CoreStatus core_set_time(Core *core, double t);
CoreStatus core_get_states(Core *core, double x[], size_t n);
CoreStatus core_set_states(Core *core, const double x[], size_t n);
CoreStatus core_get_nominals(Core *core, double nominals[], size_t n);
CoreStatus core_get_derivatives(Core *core, double dx[], size_t n);
CoreStatus core_get_indicators(Core *core, double z[], size_t n);
CoreStatus core_save(Core *core, Values *copy);
CoreStatus core_load(Core *core, const Values *copy);

CoreStatus core_event(Core *core, EventReport *report);
CoreStatus core_completed(Core *core, int *enter_event_mode);

/* sensitivity = d unknowns / d knowns * seed, and sensitivity = (d unknowns / d knowns)' * seed. */
CoreStatus core_directional(Core *core, const unsigned int unknowns[], size_t n_unknowns, const unsigned int knowns[],
                            size_t n_knowns, const double seed[], double sensitivity[], size_t n_sensitivity);
CoreStatus core_adjoint(Core *core, const unsigned int unknowns[], size_t n_unknowns, const unsigned int knowns[],
                        size_t n_knowns, const double seed[], size_t n_seed, double sensitivity[]);

/* Co-simulation, in step.c: integrate from t to t + h with inputs held; on failure the values are as before. */
CoreStatus core_step(Core *core, double t, double h, StepReport *report);

/* For step.c: dx and y at the states x, and the derivative of everything along `seed`, both by value reference. */
CoreStatus core_evaluate(Core *core, const double x[], double dx[], double y[]);
void core_tangent(const Values *values, const double seed[N_VALUES], double result[N_VALUES]);

#endif
