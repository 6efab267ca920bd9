/* What a model is to the framework: sizes and start values (config.h, generated from fmus/models.py) and functions.
 *
 * config.h defines
 *   NX, NU, NP, NY, NQ   numbers of states, inputs, parameters, outputs, discrete variables, in scalars
 *   NZ                   number of event indicators; they are the last of the NY outputs
 *   X_pA, U_d_pA, P_k1, Y_pressure, Z_floor, Q_on    names of indices; Z_ are indices of y
 *   X_START ...          start and nominal values, and the token that the model description carries
 *   STIFF, SUBSTEP       the integrator of co-simulation: 0: RK4 with steps of at most SUBSTEP seconds, 1: Rosenbrock
 * and flags, each 0 or 1: what the FMU offers and demands, and what is wrong with it (DEFECT_...).
 */
#ifndef CTMHE_MODEL_H
#define CTMHE_MODEL_H

#include "config.h"

/* dx = f(x, u, p, q) and y = h(x, u, p, q). */
void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]);

/* Directional derivative of both at (x, u, p, q) along the seeds (sx, su, sp), analytic. */
void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]);

#if HAS_EVENTS
/* What happens at an event at time t: new x and q; returns whether x changed. Must do nothing where nothing is due.
 * `next` is the time of the next planned event; infinite unless set. */
int model_event(double t, double x[], const double u[], const double p[], double q[], double *next);
#endif

#if COMPLETED_STEPS
/* An integration step ended; returns whether this asks for an event. */
int model_completed(double q[]);
#endif

#endif
