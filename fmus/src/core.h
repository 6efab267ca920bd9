/* The part of an FMU that does not depend on the FMI version: values, derivatives, co-simulation step. */
#ifndef CTMHE_CORE_H
#define CTMHE_CORE_H

#include <stddef.h>

#include "model.h"

/* Value references: 0 is time, then states, their derivatives, inputs, parameters and outputs, in this order. */
enum {
    VR_TIME = 0,
    VR_X = 1,
    VR_DX = VR_X + NX,
    VR_U = VR_DX + NX,
    VR_P = VR_U + NU,
    VR_Y = VR_P + NP,
    N_VALUES = VR_Y + NY
};

/* Everything that an FMU state holds: plain data, so that a copy is a checkpoint. */
typedef struct {
    double v[N_VALUES]; /* by value reference */
    double step;        /* step size that the error control proposes next, 0 when unknown */
    int stale;          /* derivatives and outputs wait for an evaluation */
} Values;

typedef enum { CORE_OK, CORE_BAD_REFERENCE, CORE_NOT_SETTABLE, CORE_NOT_FINITE } CoreStatus;

const char *core_message(CoreStatus status);

void core_reset(Values *values);
CoreStatus core_get(Values *values, const unsigned int vr[], size_t n, double out[]);
CoreStatus core_set(Values *values, const unsigned int vr[], size_t n, const double in[]);
void core_set_states(Values *values, const double x[]);
void core_get_derivatives(Values *values, double dx[]);

/* sensitivity = d unknowns / d knowns * seed, and sensitivity = (d unknowns / d knowns)' * seed. */
CoreStatus core_directional(const Values *values, const unsigned int unknowns[], size_t n_unknowns,
                            const unsigned int knowns[], size_t n_knowns, const double seed[],
                            double sensitivity[]);
CoreStatus core_adjoint(const Values *values, const unsigned int unknowns[], size_t n_unknowns,
                        const unsigned int knowns[], size_t n_knowns, const double seed[], double sensitivity[]);

/* Integrate from t to t + h with inputs held; on failure `values` is as before. */
CoreStatus core_step(Values *values, double t, double h);

#endif
