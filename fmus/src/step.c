/* The step of co-simulation: RK4, which finds events on its way, or a Rosenbrock method for stiff models. */
#include <math.h>
#include <string.h>

#include "core.h"

#define ROS_RTOL 1e-10
#define ROS_ATOL 1e-12

#if STIFF && (NZ > 0 || DEFECT_FAILS)
#error "the integrator for stiff models neither finds state events nor tells why an evaluation failed"
#endif

static int finite_all(const double x[], size_t n) {
    for (size_t i = 0; i < n; i++)
        if (!isfinite(x[i])) return 0;
    return 1;
}

#if !STIFF

/* One step of size d from x to z. */
static CoreStatus rk4(Core *core, double d, const double x[], double z[]) {
    static const double node[] = {0.0, 0.5, 0.5, 1.0}, weight[] = {1.0, 2.0, 2.0, 1.0};
    double k[NX] = {0}, sum[NX] = {0}, y[NY];
    for (int s = 0; s < 4; s++) {
        for (int i = 0; i < NX; i++) z[i] = x[i] + node[s] * d * k[i];
        CoreStatus status = core_evaluate(core, z, k, y);
        if (status != CORE_OK) return status;
        for (int i = 0; i < NX; i++) sum[i] += weight[s] * k[i];
    }
    for (int i = 0; i < NX; i++) z[i] = x[i] + d / 6.0 * sum[i];
    return finite_all(z, NX) ? CORE_OK : CORE_NOT_FINITE;
}

/* Whether the sign of an event indicator is another at b than at a. */
static CoreStatus compare_signs(Core *core, const double a[], const double b[], int *differ) {
    *differ = 0;
#if NZ > 0
    double dx[NX], before[NY], after[NY];
    CoreStatus status = core_evaluate(core, a, dx, before);
    if (status == CORE_OK) status = core_evaluate(core, b, dx, after);
    if (status != CORE_OK) return status;
    for (int i = NY - NZ; i < NY; i++) *differ |= (before[i] > 0.0) != (after[i] > 0.0);
#else
    (void)core, (void)a, (void)b;
#endif
    return CORE_OK;
}

/* Shorten the step *d from x to z until it ends just behind the first change of sign, by bisection. */
static CoreStatus locate(Core *core, double *d, const double x[], double z[]) {
    double low = 0.0, high = *d;
    for (int i = 0; i < 60; i++) {
        int differ;
        double middle = 0.5 * (low + high);
        CoreStatus status = rk4(core, middle, x, z);
        if (status == CORE_OK) status = compare_signs(core, x, z, &differ);
        if (status != CORE_OK) return status;
        if (differ) high = middle;
        else low = middle;
    }
    *d = high;
    return rk4(core, high, x, z);
}

/* Integrate over *h, or up to an event: then *h becomes the way to it and *event 1. */
static CoreStatus integrate(Core *core, double *h, int *event) {
    double *x = core->values.v + VR_X, z[NX];
    double count = ceil(*h / SUBSTEP * (1.0 - 1e-12));
    size_t n = count < 1.0 ? 1 : (size_t)count;
    double d = *h / (double)n;
    *event = 0;
    for (size_t k = 0; k < n && !*event; k++) {
        CoreStatus status = rk4(core, d, x, z);
        if (status == CORE_OK) status = compare_signs(core, x, z, event);
        if (status == CORE_OK && *event) {
            double done = d * (double)k;
            status = locate(core, &d, x, z);
            *h = done + d;
        }
        if (status != CORE_OK) return status;
        memcpy(x, z, NX * sizeof(double));
    }
    return CORE_OK;
}

#else

/* RODAS, order 4(3), L-stable, stiffly accurate: Hairer and Wanner, Solving Ordinary Differential Equations II,
 * section IV.10. In the form with transformed stages; the model does not depend on time. */
enum { STAGES = 6 };
static const double ros_gamma = 0.25;
static const double ros_a[STAGES][STAGES] = {
    {0},
    {1.544},
    {0.9466785280815826, 0.2557011698983284},
    {3.314825187068521, 2.896124015972201, 0.9986419139977817},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0},
};
static const double ros_c[STAGES][STAGES] = {
    {0},
    {-5.6688},
    {-2.430093356833875, -0.2063599157091915},
    {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
    {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160},
    {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054},
};

/* LU factors of a in place with row exchanges; 0 when singular. */
static int factor(double a[NX][NX], int pivot[NX]) {
    for (int k = 0; k < NX; k++) {
        int best = k;
        for (int i = k + 1; i < NX; i++)
            if (fabs(a[i][k]) > fabs(a[best][k])) best = i;
        pivot[k] = best;
        if (!(fabs(a[best][k]) > 0.0)) return 0;
        for (int j = 0; best != k && j < NX; j++) {
            double swap = a[k][j];
            a[k][j] = a[best][j];
            a[best][j] = swap;
        }
        for (int i = k + 1; i < NX; i++) {
            a[i][k] /= a[k][k];
            for (int j = k + 1; j < NX; j++) a[i][j] -= a[i][k] * a[k][j];
        }
    }
    return 1;
}

static void solve(double a[NX][NX], const int pivot[NX], double b[NX]) {
    for (int k = 0; k < NX; k++) {
        double swap = b[k];
        b[k] = b[pivot[k]];
        b[pivot[k]] = swap;
    }
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < i; j++) b[i] -= a[i][j] * b[j];
    for (int i = NX - 1; i >= 0; i--) {
        for (int j = i + 1; j < NX; j++) b[i] -= a[i][j] * b[j];
        b[i] /= a[i][i];
    }
}

/* One step of size h from x to z; returns the scaled error (1: at the tolerance), negative when it failed. */
static double rosenbrock(Core *core, const double jacobian[NX][NX], double h, const double x[NX], double z[NX]) {
    double a[NX][NX], k[STAGES][NX], f[NX], y[NY], error = 0.0;
    int pivot[NX];
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) a[i][j] = (i == j ? 1.0 / (h * ros_gamma) : 0.0) - jacobian[i][j];
    if (!factor(a, pivot)) return -1.0;
    for (int s = 0; s < STAGES; s++) {
        for (int i = 0; i < NX; i++) {
            z[i] = x[i];
            for (int j = 0; j < s; j++) z[i] += ros_a[s][j] * k[j][i];
        }
        if (core_evaluate(core, z, f, y) != CORE_OK) return -1.0;
        for (int i = 0; i < NX; i++) {
            k[s][i] = f[i];
            for (int j = 0; j < s; j++) k[s][i] += ros_c[s][j] / h * k[j][i];
        }
        solve(a, pivot, k[s]);
    }
    for (int i = 0; i < NX; i++) {
        z[i] += k[STAGES - 1][i];
        double scale = ROS_ATOL + ROS_RTOL * fmax(fabs(x[i]), fabs(z[i]));
        double e = k[STAGES - 1][i] / scale;
        error += e * e / NX;
    }
    return finite_all(z, NX) && isfinite(error) ? sqrt(error) : -1.0;
}

static CoreStatus integrate(Core *core, double *h, int *event) {
    double *x = core->values.v + VR_X, z[NX], jacobian[NX][NX], done = 0.0;
    double d = core->values.step > 0.0 ? core->values.step : 1e-4 * *h;
    *event = 0;
    while (done < *h) {
        double s[N_VALUES], result[N_VALUES];
        for (int j = 0; j < NX; j++) {
            memset(s, 0, sizeof s);
            s[VR_X + j] = 1.0;
            core_tangent(&core->values, s, result);
            for (int i = 0; i < NX; i++) jacobian[i][j] = result[VR_DX + i];
        }
        for (;;) {
            int last = done + d * (1.0 + 1e-10) >= *h;
            double trial = last ? *h - done : d;
            double error = rosenbrock(core, (const double(*)[NX])jacobian, trial, x, z);
            double growth = error < 0.0 ? 0.1 : fmin(5.0, fmax(0.2, 0.9 * pow(fmax(error, 1e-12), -0.25)));
            if (error >= 0.0 && error <= 1.0) {
                done = last ? *h : done + trial;
                if (!last || trial * growth < d) d = trial * growth; /* a clipped last step says little */
                break;
            }
            d = trial * fmin(growth, 0.9);
            if (!(d > 1e-14 * *h)) return CORE_NOT_FINITE;
        }
        memcpy(x, z, NX * sizeof(double));
    }
    core->values.step = d;
    return CORE_OK;
}

#endif

/* Go from where the values are to time `stop`, over events that are handled here, up to one that is not. */
static CoreStatus advance(Core *core, double stop, double remaining, StepReport *report) {
    Values *values = &core->values;
    double *now = values->v + VR_TIME;
    while (remaining > 0.0) {
        EventReport ignored;
        int planned = values->next_event - *now <= remaining, crossed = 0;
        double length = planned ? fmax(0.0, values->next_event - *now) : remaining;
        CoreStatus status = length > 0.0 ? integrate(core, &length, &crossed) : CORE_OK;
        if (status != CORE_OK) return status;
        planned = planned && !crossed;
        remaining = crossed || planned ? remaining - length : 0.0;
        *now = planned ? values->next_event : remaining > 0.0 ? *now + length : stop;
        values->stale = 1;
        if (!crossed && !planned) break;
        if (core->event_mode && core->early_return) {
            report->event = 1;
            break;
        }
        status = core_event(core, &ignored);
        if (status != CORE_OK) return status;
    }
    report->time = *now;
    report->early = *now < stop;
    return CORE_OK;
}

CoreStatus core_step(Core *core, double t, double h, StepReport *report) {
    Values before = core->values;
    *report = (StepReport){.time = t};
    if (core->broken) return CORE_BROKEN;
    if (!isfinite(t) || !isfinite(h) || h < 0.0) return CORE_NOT_FINITE;
    if (FIXED_STEP && fabs(h - DEFAULT_STEP) > 1e-9 * DEFAULT_STEP) return CORE_WRONG_STEP;
    core->values.v[VR_TIME] = t;
    CoreStatus status = advance(core, t + h, h, report);
    if (status != CORE_OK) {
        core->values = before;
        *report = (StepReport){.time = t};
    }
    return status;
}
