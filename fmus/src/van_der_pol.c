/* Van der Pol oscillator x0'' = mu (1 - x0^2) x0' - x0, stiff for large mu. */
#include "model.h"

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    (void)q;
    dx[X_x0] = x[X_x1] + u[U_d_x0];
    dx[X_x1] = p[P_mu] * (1.0 - x[X_x0] * x[X_x0]) * x[X_x1] - x[X_x0] + u[U_d_x1];
    y[Y_y_x0] = x[X_x0];
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    double damping = 1.0 - x[X_x0] * x[X_x0];
    (void)u, (void)q;
    ddx[X_x0] = sx[X_x1] + su[U_d_x0];
    ddx[X_x1] = p[P_mu] * (damping * sx[X_x1] - 2.0 * x[X_x0] * x[X_x1] * sx[X_x0]) + sp[P_mu] * damping * x[X_x1]
              - sx[X_x0] + su[U_d_x1];
    dy[Y_y_x0] = sx[X_x0];
}
