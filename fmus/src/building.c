/* Two zones, each with an outer wall: a network of resistances R [K/W] and capacities C [J/K], temperatures in K.
 *
 *     C_z dT1/dt  = (Tw1 - T1) / R_zw + (T2 - T1) / R_zz + heat1 + A1 solar
 *     C_z dT2/dt  = (Tw2 - T2) / R_zw + (T1 - T2) / R_zz + heat2 + A2 solar
 *     C_w dTw1/dt = (T1 - Tw1) / R_zw + (T_out - Tw1) / R_wo
 *     C_w dTw2/dt = (T2 - Tw2) / R_zw + (T_out - Tw2) / R_wo
 *     y_T1 = T1,  y_T2 = T2,  loss = (Tw1 - T_out) / R_wo + (Tw2 - T_out) / R_wo
 *
 * With the start values of the parameters a zone follows its wall within 0.7 to 1.3 hours, and the whole cools down to
 * the outdoors with a time constant of 2.6 days. A watt in each zone makes both warmer by R_zw + R_wo = 0.025 K.
 */
#include "model.h"

void model_evaluate(const double x[], const double u[], const double p[], const double q[], double dx[], double y[]) {
    (void)q;
    y[Y_loss] = 0.0;
    for (int i = 0; i < 2; i++) {
        double zone = x[X_T1 + i], wall = x[X_Tw1 + i];
        double inward = (wall - zone) / p[P_R_zw], outward = (wall - u[U_T_out]) / p[P_R_wo];
        double across = (x[X_T1 + 1 - i] - zone) / p[P_R_zz];
        dx[X_T1 + i] = (inward + across + u[U_heat1 + i] + p[P_A1 + i] * u[U_solar]) / p[P_C_z];
        dx[X_Tw1 + i] = (-inward - outward) / p[P_C_w];
        y[Y_y_T1 + i] = zone;
        y[Y_loss] += outward;
    }
}

/* The derivative of the flow difference / resistance. */
static double d_flow(double difference, double resistance, double s_difference, double s_resistance) {
    return (s_difference - difference / resistance * s_resistance) / resistance;
}

void model_tangent(const double x[], const double u[], const double p[], const double q[],
                   const double sx[], const double su[], const double sp[], double ddx[], double dy[]) {
    double dx[NX], y[NY];
    model_evaluate(x, u, p, q, dx, y);
    dy[Y_loss] = 0.0;
    for (int i = 0; i < 2; i++) {
        int zone = X_T1 + i, wall = X_Tw1 + i, other = X_T1 + 1 - i;
        double inward = d_flow(x[wall] - x[zone], p[P_R_zw], sx[wall] - sx[zone], sp[P_R_zw]);
        double outward = d_flow(x[wall] - u[U_T_out], p[P_R_wo], sx[wall] - su[U_T_out], sp[P_R_wo]);
        double across = d_flow(x[other] - x[zone], p[P_R_zz], sx[other] - sx[zone], sp[P_R_zz]);
        double gain = su[U_heat1 + i] + sp[P_A1 + i] * u[U_solar] + p[P_A1 + i] * su[U_solar];
        ddx[zone] = (inward + across + gain - dx[zone] * sp[P_C_z]) / p[P_C_z];
        ddx[wall] = (-inward - outward - dx[wall] * sp[P_C_w]) / p[P_C_w];
        dy[Y_y_T1 + i] = sx[zone];
        dy[Y_loss] += outward;
    }
}
