/* What a model is to the framework: sizes and start values (config.h, generated from fmus/models.py) and two functions.
 *
 * config.h defines NX, NU, NP, NY (numbers of states, inputs, tunable parameters, outputs), index names such as
 * X_pA, U_d_pA, P_k1, Y_pressure, the start and nominal values, the token that the model description carries, and
 * STIFF (0: RK4 with a fixed step, 1: Rosenbrock with error control) for co-simulation.
 */
#ifndef CTMHE_MODEL_H
#define CTMHE_MODEL_H

#include "config.h"

/* dx = f(x, u, p) and y = h(x, u, p). */
void model_evaluate(const double x[], const double u[], const double p[], double dx[], double y[]);

/* Directional derivative of both at (x, u, p) along the seeds (sx, su, sp), analytic. */
void model_tangent(const double x[], const double u[], const double p[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]);

#endif
