/* C dT/dt = on power - (T - T_room) / R, where `on` is 1 from 0 to period, 0 from there to 2 period, and so on. */
#include <math.h>

#include "model.h"

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    dx[X_T] = (q[Q_on] * p[P_power] - (x[X_T] - u[U_T_room]) / p[P_R]) / p[P_C];
    y[Y_y_T] = x[X_T];
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    double loss = (x[X_T] - u[U_T_room]) / p[P_R], rate = (q[Q_on] * p[P_power] - loss) / p[P_C];
    double d_loss = (sx[X_T] - su[U_T_room] - loss * sp[P_R]) / p[P_R];
    ddx[X_T] = (q[Q_on] * sp[P_power] - d_loss - rate * sp[P_C]) / p[P_C];
    dy[Y_y_T] = sx[X_T];
}

int model_event(double t, double x[], const double u[], const double p[], double q[], double *next) {
    double count = floor(t / p[P_period] + 1e-9); /* an event that comes a rounding early counts as on time */
    (void)x, (void)u;
    q[Q_on] = fmod(count, 2.0) == 0.0 ? 1.0 : 0.0;
    *next = (count + 1.0) * p[P_period];
    return 0;
}
