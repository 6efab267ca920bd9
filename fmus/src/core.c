/* Values, directional derivatives and the integrators of co-simulation: see core.h. */
#include "core.h"

#include <math.h>
#include <string.h>

#define RK4_MAX_STEP 1e-3
#define ROS_RTOL 1e-10
#define ROS_ATOL 1e-12

static const double x_start[] = X_START, u_start[] = U_START, p_start[] = P_START;

const char *core_message(CoreStatus status) {
    switch (status) {
    case CORE_BAD_REFERENCE: return "a value reference is unknown, or has no derivative in this role";
    case CORE_NOT_SETTABLE: return "only states, inputs and parameters can be set";
    case CORE_NOT_FINITE: return "the integration left the finite numbers, or its step size vanished";
    default: return "ok";
    }
}

void core_reset(Values *values) {
    memset(values, 0, sizeof *values);
    memcpy(values->v + VR_X, x_start, NX * sizeof(double));
    memcpy(values->v + VR_U, u_start, NU * sizeof(double));
    memcpy(values->v + VR_P, p_start, NP * sizeof(double));
    values->stale = 1;
}

static void refresh(Values *values) {
    double *v = values->v;
    if (!values->stale) return;
    model_evaluate(v + VR_X, v + VR_U, v + VR_P, v + VR_DX, v + VR_Y);
    values->stale = 0;
}

CoreStatus core_get(Values *values, const unsigned int vr[], size_t n, double out[]) {
    for (size_t i = 0; i < n; i++)
        if (vr[i] >= N_VALUES) return CORE_BAD_REFERENCE;
    for (size_t i = 0; i < n; i++) {
        if ((vr[i] >= VR_DX && vr[i] < VR_U) || vr[i] >= VR_Y) refresh(values);
        out[i] = values->v[vr[i]];
    }
    return CORE_OK;
}

CoreStatus core_set(Values *values, const unsigned int vr[], size_t n, const double in[]) {
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= N_VALUES) return CORE_BAD_REFERENCE;
        if (vr[i] == VR_TIME || (vr[i] >= VR_DX && vr[i] < VR_U) || vr[i] >= VR_Y) return CORE_NOT_SETTABLE;
    }
    for (size_t i = 0; i < n; i++) values->v[vr[i]] = in[i];
    values->stale = 1;
    return CORE_OK;
}

void core_set_states(Values *values, const double x[]) {
    memcpy(values->v + VR_X, x, NX * sizeof(double));
    values->stale = 1;
}

void core_get_derivatives(Values *values, double dx[]) {
    refresh(values);
    memcpy(dx, values->v + VR_DX, NX * sizeof(double));
}

/* ---- derivatives ---- */

/* Fill `result` (by value reference) with the derivative of x, dx, u, p, y along `seed` (by value reference). */
static void tangent(const Values *values, const double seed[N_VALUES], double result[N_VALUES]) {
    const double *v = values->v;
    memcpy(result, seed, N_VALUES * sizeof(double));
    model_tangent(v + VR_X, v + VR_U, v + VR_P, seed + VR_X, seed + VR_U, seed + VR_P, result + VR_DX,
                  result + VR_Y);
}

static int is_known(unsigned int vr) { /* no model depends on time, so its derivative is zero */
    return vr < VR_DX || (vr >= VR_U && vr < VR_Y);
}

static CoreStatus check(const unsigned int unknowns[], size_t n_unknowns, const unsigned int knowns[],
                        size_t n_knowns) {
    for (size_t i = 0; i < n_unknowns; i++)
        if (unknowns[i] >= N_VALUES) return CORE_BAD_REFERENCE;
    for (size_t i = 0; i < n_knowns; i++)
        if (!is_known(knowns[i])) return CORE_BAD_REFERENCE;
    return CORE_OK;
}

CoreStatus core_directional(const Values *values, const unsigned int unknowns[], size_t n_unknowns,
                            const unsigned int knowns[], size_t n_knowns, const double seed[],
                            double sensitivity[]) {
    double s[N_VALUES] = {0}, result[N_VALUES];
    CoreStatus status = check(unknowns, n_unknowns, knowns, n_knowns);
    if (status != CORE_OK) return status;
    for (size_t i = 0; i < n_knowns; i++) s[knowns[i]] += seed[i];
    tangent(values, s, result);
    for (size_t i = 0; i < n_unknowns; i++) sensitivity[i] = result[unknowns[i]];
    return CORE_OK;
}

CoreStatus core_adjoint(const Values *values, const unsigned int unknowns[], size_t n_unknowns,
                        const unsigned int knowns[], size_t n_knowns, const double seed[], double sensitivity[]) {
    CoreStatus status = check(unknowns, n_unknowns, knowns, n_knowns);
    if (status != CORE_OK) return status;
    for (size_t j = 0; j < n_knowns; j++) {
        double s[N_VALUES] = {0}, result[N_VALUES];
        s[knowns[j]] = 1.0;
        tangent(values, s, result);
        sensitivity[j] = 0.0;
        for (size_t i = 0; i < n_unknowns; i++) sensitivity[j] += seed[i] * result[unknowns[i]];
    }
    return CORE_OK;
}

/* ---- co-simulation ---- */

static int finite_all(const double x[], size_t n) {
    for (size_t i = 0; i < n; i++)
        if (!isfinite(x[i])) return 0;
    return 1;
}

#if !STIFF

static CoreStatus integrate(Values *values, double h) {
    const double *u = values->v + VR_U, *p = values->v + VR_P;
    double *x = values->v + VR_X;
    double k1[NX], k2[NX], k3[NX], k4[NX], z[NX], y[NY];
    double count = ceil(h / RK4_MAX_STEP * (1.0 - 1e-12));
    size_t n = count < 1.0 ? 1 : (size_t)count;
    double d = h / (double)n;
    for (size_t k = 0; k < n; k++) {
        model_evaluate(x, u, p, k1, y);
        for (int i = 0; i < NX; i++) z[i] = x[i] + 0.5 * d * k1[i];
        model_evaluate(z, u, p, k2, y);
        for (int i = 0; i < NX; i++) z[i] = x[i] + 0.5 * d * k2[i];
        model_evaluate(z, u, p, k3, y);
        for (int i = 0; i < NX; i++) z[i] = x[i] + d * k3[i];
        model_evaluate(z, u, p, k4, y);
        for (int i = 0; i < NX; i++) x[i] += d / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    }
    return finite_all(x, NX) ? CORE_OK : CORE_NOT_FINITE;
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
static double rosenbrock(const Values *values, const double jacobian[NX][NX], double h, const double x[NX],
                         double z[NX]) {
    const double *u = values->v + VR_U, *p = values->v + VR_P;
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
        model_evaluate(z, u, p, f, y);
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

static CoreStatus integrate(Values *values, double h) {
    double *x = values->v + VR_X, z[NX], jacobian[NX][NX], done = 0.0;
    double d = values->step > 0.0 ? values->step : 1e-4 * h;
    while (done < h) {
        double s[N_VALUES], result[N_VALUES];
        for (int j = 0; j < NX; j++) {
            memset(s, 0, sizeof s);
            s[VR_X + j] = 1.0;
            tangent(values, s, result);
            for (int i = 0; i < NX; i++) jacobian[i][j] = result[VR_DX + i];
        }
        for (;;) {
            int last = done + d * (1.0 + 1e-10) >= h;
            double trial = last ? h - done : d;
            double error = rosenbrock(values, (const double(*)[NX])jacobian, trial, x, z);
            double growth = error < 0.0 ? 0.1 : fmin(5.0, fmax(0.2, 0.9 * pow(fmax(error, 1e-12), -0.25)));
            if (error >= 0.0 && error <= 1.0) {
                done = last ? h : done + trial;
                if (!last || trial * growth < d) d = trial * growth; /* a clipped last step says little */
                break;
            }
            d = trial * fmin(growth, 0.9);
            if (!(d > 1e-14 * h)) return CORE_NOT_FINITE;
        }
        memcpy(x, z, NX * sizeof(double));
    }
    values->step = d;
    return CORE_OK;
}

#endif

CoreStatus core_step(Values *values, double t, double h) {
    Values before = *values;
    CoreStatus status = CORE_OK;
    if (!isfinite(t) || !isfinite(h) || h < 0.0) return CORE_NOT_FINITE;
    if (h > 0.0) status = integrate(values, h);
    if (status != CORE_OK) {
        *values = before;
        return status;
    }
    values->v[VR_TIME] = t + h;
    values->stale = 1;
    return CORE_OK;
}
