/* One integration step of a model that evaluates itself: RK4, or the step map that the model is. */
#ifndef CTMHE_OWN_H
#define CTMHE_OWN_H

#include "layout.h"

/* Derivatives by (x, w, p) at the step's start of rows first..end-1 of (dx, y), from those J at the point and S of the
 * point's x (its first nx rows); all have ld = nx + ny rows, column-major. Jacobians of large models are sparse, and J is multiplied by many columns: `list`
 * ((ld + 1) nx) holds, for each of the first nx columns, the number of entries that are not zero, and their rows. */
INLINE void chain(const double *restrict J, const double *restrict S, double *restrict result, int *restrict list, int ld,
                  int nx, int n, int first, int end) {
  for (int l = 0; l < nx; l++) {
    int *entry = list + l * (ld + 1), count = 0;
    for (int i = first; i < end; i++)
      if (J[l * ld + i] != 0.0) entry[++count] = i;
    entry[0] = count;
  }
  for (int column = 0; column < n; column++) {
    const double *direct = J + column * ld, *s = S + column * ld;
    double *to = result + column * ld;
    for (int i = first; i < end; i++) to[i] = column < nx ? 0.0 : direct[i];
    for (int l = 0; l < nx; l++) {
      const double a = s[l], *from = J + l * ld;
      const int *entry = list + l * (ld + 1), count = entry[0];
      if (a == 0.0) continue;
      for (int e = 1; e <= count; e++) to[entry[e]] += a * from[entry[e]];
    }
  }
}

/* S = I + a K, of whose rows the first nx matter. */
INLINE void shift(double *restrict S, const double *restrict K, double a, int ld, int nx, int n) {
  for (int i = 0; i < ld * n; i++) S[i] = a * K[i];
  for (int i = 0; i < nx; i++) S[i * ld + i] += 1.0;
}

/* f->work holds 3 nx + 4 (nx + ny) n + nx (nx + ny + 1) doubles, n = nx + nw + np. */
static int own_step(const ctmhe_stage *s, const ctmhe_function *f, const call *c, int derivatives) {
  static const double reach[4] = {0.0, 0.5, 0.5, 1.0}, share[4] = {1.0 / 6, 2.0 / 6, 2.0 / 6, 1.0 / 6};
  const int nx = NX(s), ny = NY(s), nu = s->nu, n = nx + NW(s) + NP(s), ld = nx + ny, points = POINTS(s);
  const int height = nx + points * ny, nodes = points > 1, map = f->method == CTMHE_STEP_MAP;
  const double t = *c->arg[0], h = *c->arg[1], *x = c->arg[2], *w = c->arg[3], *p = c->arg[4];
  const double *u0 = c->arg[5], *u1 = c->arg[6];
  double *x_next = c->res[0], *y = c->res[1], *result = derivatives ? c->res[2] : NULL;
  double *k = f->work, *moved = k + nx, *sum = moved + nx, *J = sum + nx, *K = J + ld * n, *total = K + ld * n;
  double *S = total + ld * n, *j = derivatives ? J : NULL;
  int *list = (int *)(S + ld * n);

  if (map) {
    const int stays = !(h > 0.0);
    if (f->evaluate(f->model, t, x, u0, w, p, stays ? NULL : x_next, y, j)) return 1;
    for (int i = 0; stays && i < nx; i++) x_next[i] = x[i];
    for (int column = 0; derivatives && column < n; column++)
      for (int i = 0; i < ld; i++)
        result[column * height + i] = stays && i < nx ? i == column : J[column * ld + i];
    return 0;
  }

  for (int i = 0; i < nx; i++) moved[i] = x[i], sum[i] = 0.0;
  for (int i = 0; derivatives && i < ld * n; i++) total[i] = 0.0;
  for (int stage = 0; stage < 4 && (h != 0.0 || nodes); stage++) {
    double *rates = stage ? K : J; /* S is the identity at first */
    if (stage) {
      for (int i = 0; i < nx; i++) moved[i] = x[i] + reach[stage] * h * k[i];
      if (derivatives) shift(S, stage == 1 ? J : K, reach[stage] * h, ld, nx, n);
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
    if (stage) chain(J, S, K, list, ld, nx, n, 0, nodes ? ld : nx);
    for (int i = 0; i < ld * n; i++) total[i] += share[stage] * rates[i];
    for (int column = 0; nodes && column < n; column++)
      for (int i = 0; i < ny; i++) result[column * height + nx + stage * ny + i] = rates[column * ld + nx + i];
  }
  for (int i = 0; i < nx; i++) x_next[i] = x[i] + h * sum[i];
  if (f->evaluate(f->model, t + h, x_next, u1, w, p, NULL, y + (points - 1) * ny, j)) return 1;
  if (!derivatives) return 0;
  shift(S, total, h, ld, nx, n);
  chain(J, S, K, list, ld, nx, n, nx, ld);
  for (int column = 0; column < n; column++) {
    double *to = result + column * height;
    for (int i = 0; i < nx; i++) to[i] = S[column * ld + i];
    for (int i = 0; i < ny; i++) to[nx + (points - 1) * ny + i] = K[column * ld + nx + i];
  }
  return 0;
}

#endif
