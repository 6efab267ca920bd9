/* Quadrotor with flexible blades, thesis (3.45): z down, thrust along the negative body axis, zyx angles. */
#include "model.h"

#include <math.h>

typedef struct {
    double v[3];
} Vec;

/* R(xi) f with R = Rz(psi) Ry(theta) Rx(phi). */
static Vec rotate(const double x[], Vec f) {
    double sf = sin(x[X_phi]), cf = cos(x[X_phi]);
    double st = sin(x[X_theta]), ct = cos(x[X_theta]);
    double sp = sin(x[X_psi]), cp = cos(x[X_psi]);
    double a = f.v[0], b = cf * f.v[1] - sf * f.v[2], c = sf * f.v[1] + cf * f.v[2];
    double d = ct * a + st * c;
    return (Vec){{cp * d - sp * b, sp * d + cp * b, -st * a + ct * c}};
}

/* Force of thrust and blade flapping in the body frame, e3 T + B Omega. */
static Vec force(const double x[], const double u[], const double p[]) {
    double sum = 0.0;
    for (int i = 0; i < 4; i++) sum += u[U_omega1 + i] * u[U_omega1 + i];
    return (Vec){{-p[P_b] * x[X_O2], p[P_b] * x[X_O1], p[P_cT] * sum}};
}

/* Omega' times its moment of inertia. */
static Vec torque(const double x[], const double u[], const double p[]) {
    double w1 = u[U_omega1] * u[U_omega1], w2 = u[U_omega2] * u[U_omega2];
    double w3 = u[U_omega3] * u[U_omega3], w4 = u[U_omega4] * u[U_omega4];
    double o1 = x[X_O1], o2 = x[X_O2], o3 = x[X_O3];
    return (Vec){{
        p[P_l] * p[P_cT] * (w4 - w2) - (p[P_J3] - p[P_J2]) * o2 * o3,
        p[P_l] * p[P_cT] * (w1 - w3) - (p[P_J1] - p[P_J3]) * o1 * o3,
        p[P_cQ] * (w2 + w4 - w1 - w3) - (p[P_J2] - p[P_J1]) * o1 * o2 - p[P_d] * o3,
    }};
}

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    (void)q;
    double sf = sin(x[X_phi]), cf = cos(x[X_phi]), tt = tan(x[X_theta]), ct = cos(x[X_theta]);
    double turn = sf * x[X_O2] + cf * x[X_O3];
    Vec f = rotate(x, force(x, u, p)), tau = torque(x, u, p);
    for (int i = 0; i < 3; i++) {
        dx[X_z1 + i] = x[X_s1 + i];
        dx[X_s1 + i] = -f.v[i] / p[P_m];
        dx[X_O1 + i] = tau.v[i] / p[P_J1 + i];
    }
    dx[X_s3] += p[P_g];
    dx[X_phi] = x[X_O1] + tt * turn;
    dx[X_theta] = cf * x[X_O2] - sf * x[X_O3];
    dx[X_psi] = turn / ct;
    for (int i = 0; i < 6; i++) y[Y_y_z1 + i] = x[X_z1 + i];
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    (void)q;
    double sf = sin(x[X_phi]), cf = cos(x[X_phi]), st = sin(x[X_theta]), ct = cos(x[X_theta]), tt = st / ct;
    double turn = sf * x[X_O2] + cf * x[X_O3], pitch = cf * x[X_O2] - sf * x[X_O3];
    double d_turn = sx[X_phi] * pitch + sf * sx[X_O2] + cf * sx[X_O3];
    double d_pitch = -sx[X_phi] * turn + cf * sx[X_O2] - sf * sx[X_O3];
    double o1 = x[X_O1], o2 = x[X_O2], o3 = x[X_O3], d1 = sx[X_O1], d2 = sx[X_O2], d3 = sx[X_O3];
    double lc = p[P_l] * p[P_cT], d_lc = sp[P_l] * p[P_cT] + p[P_l] * sp[P_cT];
    double w[4], dw[4], sum = 0.0, d_sum = 0.0;
    for (int i = 0; i < 4; i++) {
        w[i] = u[U_omega1 + i] * u[U_omega1 + i];
        dw[i] = 2.0 * u[U_omega1 + i] * su[U_omega1 + i];
        sum += w[i];
        d_sum += dw[i];
    }

    /* d(R f) = R (r x f + df), where r is the body rate that turns the attitude along the seed */
    Vec f = force(x, u, p);
    double r1 = sx[X_phi] - st * sx[X_psi];
    double r2 = cf * sx[X_theta] + sf * ct * sx[X_psi];
    double r3 = -sf * sx[X_theta] + cf * ct * sx[X_psi];
    Vec df = rotate(x, (Vec){{
        r2 * f.v[2] - r3 * f.v[1] - sp[P_b] * o2 - p[P_b] * d2,
        r3 * f.v[0] - r1 * f.v[2] + sp[P_b] * o1 + p[P_b] * d1,
        r1 * f.v[1] - r2 * f.v[0] + sp[P_cT] * sum + p[P_cT] * d_sum,
    }});
    f = rotate(x, f);

    Vec tau = torque(x, u, p);
    Vec d_tau = {{
        d_lc * (w[3] - w[1]) + lc * (dw[3] - dw[1]) - (sp[P_J3] - sp[P_J2]) * o2 * o3
            - (p[P_J3] - p[P_J2]) * (d2 * o3 + o2 * d3),
        d_lc * (w[0] - w[2]) + lc * (dw[0] - dw[2]) - (sp[P_J1] - sp[P_J3]) * o1 * o3
            - (p[P_J1] - p[P_J3]) * (d1 * o3 + o1 * d3),
        sp[P_cQ] * (w[1] + w[3] - w[0] - w[2]) + p[P_cQ] * (dw[1] + dw[3] - dw[0] - dw[2])
            - (sp[P_J2] - sp[P_J1]) * o1 * o2 - (p[P_J2] - p[P_J1]) * (d1 * o2 + o1 * d2)
            - sp[P_d] * o3 - p[P_d] * d3,
    }};

    for (int i = 0; i < 3; i++) {
        ddx[X_z1 + i] = sx[X_s1 + i];
        ddx[X_s1 + i] = (-df.v[i] + f.v[i] / p[P_m] * sp[P_m]) / p[P_m];
        ddx[X_O1 + i] = (d_tau.v[i] - tau.v[i] / p[P_J1 + i] * sp[P_J1 + i]) / p[P_J1 + i];
    }
    ddx[X_s3] += sp[P_g];
    ddx[X_phi] = d1 + tt * d_turn + turn * sx[X_theta] / (ct * ct);
    ddx[X_theta] = d_pitch;
    ddx[X_psi] = (d_turn + turn * tt * sx[X_theta]) / ct;
    for (int i = 0; i < 6; i++) dy[Y_y_z1 + i] = sx[X_z1 + i];
}
