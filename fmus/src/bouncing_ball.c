/* A ball falls under gravity g and leaves the floor with e times the speed of its impact; it rests once that is less
 * than 0.1 m/s. From rest at height h the first impact is after sqrt(2 h / g) seconds.
 */
#include <float.h>

#include "model.h"

#define REST_SPEED 0.1

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    int flies = q[Q_resting] == 0.0;
    (void)u;
    dx[X_height] = flies ? x[X_velocity] : 0.0;
    dx[X_velocity] = flies ? -p[P_g] : 0.0;
    y[Y_y_height] = x[X_height];
    y[Z_floor] = flies ? x[X_height] : 1.0;
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    int flies = q[Q_resting] == 0.0;
    (void)x, (void)u, (void)p, (void)su;
    ddx[X_height] = flies ? sx[X_velocity] : 0.0;
    ddx[X_velocity] = flies ? -sp[P_g] : 0.0;
    dy[Y_y_height] = sx[X_height];
    dy[Z_floor] = flies ? sx[X_height] : 0.0;
}

int model_event(double t, double x[], const double u[], const double p[], double q[], double *next) {
    (void)t, (void)u, (void)next;
    if (q[Q_resting] != 0.0 || x[X_height] > 0.0 || x[X_velocity] >= 0.0) return 0;
    x[X_height] = DBL_MIN; /* above the floor, so that the indicator does not start at zero */
    x[X_velocity] *= -p[P_e];
    q[Q_bounces] += 1.0;
    if (x[X_velocity] < REST_SPEED) {
        x[X_height] = x[X_velocity] = 0.0;
        q[Q_resting] = 1.0;
    }
    return 1;
}
