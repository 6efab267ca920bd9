/* angle'' = -k sin(angle) - c angle' + torque, the model of the traps; what a trap adds is behind its flag. */
#include <math.h>

#include "model.h"

#if COMPLETED_STEPS
#define LOAD q[Q_load]
#else
#define LOAD 0.0
#endif

#if STRUCTURAL
#define DAMPERS q[Q_dampers]
#else
#define DAMPERS 1.0
#endif

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    (void)q;
    dx[X_angle] = x[X_rate];
    dx[X_rate] = -p[P_k] * sin(x[X_angle]) - DAMPERS * p[P_c] * x[X_rate] + u[U_torque] - LOAD;
    y[Y_position] = sin(x[X_angle]);
#if ARRAY_SIZE > 1
    y[Y_motion] = x[X_angle];
    y[Y_motion + 1] = x[X_rate];
#endif
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    double stiffness = -p[P_k] * cos(x[X_angle]);
    (void)u, (void)q;
#if DEFECT_WRONG_DERIVATIVES
    stiffness = -stiffness;
#endif
    ddx[X_angle] = sx[X_rate];
    ddx[X_rate] = stiffness * sx[X_angle] - sp[P_k] * sin(x[X_angle])
                - DAMPERS * (p[P_c] * sx[X_rate] + sp[P_c] * x[X_rate]) + su[U_torque];
    dy[Y_position] = cos(x[X_angle]) * sx[X_angle];
#if ARRAY_SIZE > 1
    dy[Y_motion] = sx[X_angle];
    dy[Y_motion + 1] = sx[X_rate];
#endif
}

#if COMPLETED_STEPS
int model_completed(double q[]) {
    q[Q_steps] += 1.0;
    return q[Q_steps] >= 10.0;
}

int model_event(double t, double x[], const double u[], const double p[], double q[], double *next) {
    (void)t, (void)x, (void)u, (void)p, (void)next;
    if (q[Q_steps] < 10.0) return 0;
    q[Q_steps] = 0.0;
    q[Q_load] += 0.1;
    return 0;
}
#endif
