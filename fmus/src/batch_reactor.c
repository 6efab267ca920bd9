/* Reversible reaction 2A <-> B in a batch reactor, thesis (3.42) with additive disturbances as in (3.44). */
#include "model.h"

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    (void)q;
    double rate = p[P_k1] * x[X_pA] * x[X_pA] - p[P_k2] * x[X_pB];
    dx[X_pA] = -2.0 * rate + u[U_d_pA];
    dx[X_pB] = rate + u[U_d_pB];
    y[Y_pressure] = x[X_pA] + x[X_pB];
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    double rate = 2.0 * p[P_k1] * x[X_pA] * sx[X_pA] + sp[P_k1] * x[X_pA] * x[X_pA]
                - p[P_k2] * sx[X_pB] - sp[P_k2] * x[X_pB];
    (void)u, (void)q;
    ddx[X_pA] = -2.0 * rate + su[U_d_pA];
    ddx[X_pB] = rate + su[U_d_pB];
    dy[Y_pressure] = sx[X_pA] + sx[X_pB];
}
