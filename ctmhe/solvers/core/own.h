/* One integration step of a model that evaluates itself: RK4, or the step map that the model is. */
#ifndef CTMHE_OWN_H
#define CTMHE_OWN_H

#include "layout.h"

#if defined(__GNUC__) && !defined(__clang__) /* rows of derivatives are vectors, whatever -O says */
#pragma GCC push_options
#pragma GCC optimize("tree-vectorize")
#endif

/* Matrices of derivatives by (x, w, p) at the step's start have their n columns side by side; the model's J (ld rows) is
 * column-major.
 *
 * Rows first..end-1 of R = those of (dx, y), from S = those of x at the point where J is. */
INLINE void chain(const double *restrict J, const double *restrict S, double *restrict R, int ld, int nx, int n,
                  int first, int end) {
  for (int i = first; i < end; i++) {
    double *row = R + i * n;
    for (int c = 0; c < nx; c++) row[c] = 0.0;
    for (int c = nx; c < n; c++) row[c] = J[c * ld + i];
    for (int l = 0; l < nx; l++) {
      const double a = J[l * ld + i], *from = S + l * n;
      if (a == 0.0) continue; /* Jacobians of large models are sparse */
      for (int c = 0; c < n; c++) row[c] += a * from[c];
    }
  }
}

/* S = I + a K. */
INLINE void shift(double *restrict S, const double *restrict K, double a, int nx, int n) {
  for (int i = 0; i < nx * n; i++) S[i] = a * K[i];
  for (int i = 0; i < nx; i++) S[i * n + i] += 1.0;
}

INLINE void add(double *restrict sum, const double *restrict K, double a, int count) {
  for (int i = 0; i < count; i++) sum[i] += a * K[i];
}

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC pop_options
#endif

/* Copy rows first..end-1 of R to the column-major result, from row `to` on. */
static void hand_out(const double *R, int first, int end, double *result, int height, int to, int n) {
  for (int i = first; i < end; i++, to++)
    for (int c = 0; c < n; c++) result[c * height + to] = R[i * n + c];
}

/* f->work holds 3 nx + (nx + ny) n for J and as much for K, 2 nx n for S and the sum: n = nx + nw + np. */
static int own_step(const ctmhe_stage *s, const ctmhe_function *f, const call *c, int derivatives) {
  static const double reach[4] = {0.0, 0.5, 0.5, 1.0}, share[4] = {1.0 / 6, 2.0 / 6, 2.0 / 6, 1.0 / 6};
  const int nx = NX(s), ny = NY(s), nu = s->nu, n = nx + NW(s) + NP(s), ld = nx + ny, points = POINTS(s);
  const int height = nx + points * ny, nodes = points > 1;
  const double t = *c->arg[0], h = *c->arg[1], *x = c->arg[2], *w = c->arg[3], *p = c->arg[4];
  const double *u0 = c->arg[5], *u1 = c->arg[6];
  double *x_next = c->res[0], *y = c->res[1], *result = derivatives ? c->res[2] : NULL;
  double *k = f->work, *moved = k + nx, *sum = moved + nx, *J = sum + nx, *K = J + ld * n, *S = K + ld * n;
  double *total = S + nx * n, *j = derivatives ? J : NULL;

  if (f->method == CTMHE_STEP_MAP) {
    const int stays = !(h > 0.0);
    if (f->evaluate(f->model, t, x, u0, w, p, stays ? NULL : x_next, y, j)) return 1;
    for (int i = 0; stays && i < nx; i++) x_next[i] = x[i];
    for (int column = 0; derivatives && column < n; column++)
      for (int i = 0; i < ld; i++)
        result[column * height + i] = stays && i < nx ? i == column : J[column * ld + i];
    return 0;
  }

  for (int i = 0; i < nx; i++) moved[i] = x[i], sum[i] = 0.0;
  for (int i = 0; derivatives && i < nx * n; i++) S[i] = total[i] = 0.0;
  for (int i = 0; derivatives && i < nx; i++) S[i * n + i] = 1.0;
  for (int stage = 0; stage < 4 && (h != 0.0 || nodes); stage++) {
    if (stage) {
      for (int i = 0; i < nx; i++) moved[i] = x[i] + reach[stage] * h * k[i];
      if (derivatives) shift(S, K, reach[stage] * h, nx, n);
    }
    const double *u = u0;
    if (stage && nu) {
      for (int i = 0; i < nu; i++) f->input[i] = stage == 3 ? u1[i] : (u0[i] + u1[i]) / 2;
      u = f->input;
    }
    double *out = nodes ? y + stage * ny : NULL;
    if (f->evaluate(f->model, t + reach[stage] * h, moved, u, w, p, k, out, j)) return 1;
    for (int i = 0; i < nx; i++) sum[i] += share[stage] * k[i];
    if (!derivatives) continue;
    chain(J, S, K, ld, nx, n, 0, nodes ? ld : nx);
    add(total, K, share[stage], nx * n);
    if (nodes) hand_out(K, nx, ld, result, height, nx + stage * ny, n);
  }
  for (int i = 0; i < nx; i++) x_next[i] = x[i] + h * sum[i];
  if (derivatives) {
    shift(S, total, h, nx, n);
    hand_out(S, 0, nx, result, height, 0, n);
  }
  if (c->inner) return 0;
  if (f->evaluate(f->model, t + h, x_next, u1, w, p, NULL, y + (points - 1) * ny, j)) return 1;
  if (!derivatives) return 0;
  chain(J, S, K, ld, nx, n, nx, ld);
  hand_out(K, nx, ld, result, height, nx + (points - 1) * ny, n);
  return 0;
}

#endif
