/* The modified Chua circuit, thesis section 5.2.4, in continuous time and with additive disturbances. */
#include "model.h"

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    double x1 = x[X_x1], current = ((p[P_p] * x1 + p[P_a2]) * x1 + p[P_a1]) * x1;
    (void)q;
    dx[X_x1] = p[P_b1] * (x[X_x2] - current) + u[U_d_x1];
    dx[X_x2] = x1 - x[X_x2] + x[X_x3] + u[U_d_x2];
    dx[X_x3] = -p[P_b2] * x[X_x2] + u[U_d_x3];
    y[Y_voltage] = x1;
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    double x1 = x[X_x1], current = ((p[P_p] * x1 + p[P_a2]) * x1 + p[P_a1]) * x1;
    double d_current = ((3.0 * p[P_p] * x1 + 2.0 * p[P_a2]) * x1 + p[P_a1]) * sx[X_x1]
                     + ((sp[P_p] * x1 + sp[P_a2]) * x1 + sp[P_a1]) * x1;
    (void)u, (void)q;
    ddx[X_x1] = p[P_b1] * (sx[X_x2] - d_current) + sp[P_b1] * (x[X_x2] - current) + su[U_d_x1];
    ddx[X_x2] = sx[X_x1] - sx[X_x2] + sx[X_x3] + su[U_d_x2];
    ddx[X_x3] = -p[P_b2] * sx[X_x2] - sp[P_b2] * x[X_x2] + su[U_d_x3];
    dy[Y_voltage] = sx[X_x1];
}
