/* One integration step of a model that evaluates itself: RK4, or the step map that the model is. */
#ifndef CTMHE_OWN_H
#define CTMHE_OWN_H

#include "layout.h"

/* rows = A S + the columns of J by w and p, for `count` rows of J (ld rows) from `first` on; S (nx, n) is d x / d(x, w, p)
 * column-major, and so is `result` with `height` rows. */
static void follow(const double *J, int ld, int first, int count, const double *S, int nx, int n, double *result,
                   int height) {
  for (int column = 0; column < n; column++) {
    const double *direct = J + column * ld + first, *s = S + column * nx;
    double *to = result + column * height;
    for (int i = 0; i < count; i++) to[i] = column < nx ? 0.0 : direct[i];
    for (int l = 0; l < nx; l++) {
      const double a = s[l], *from = J + l * ld + first;
      if (a == 0.0) continue;
      for (int i = 0; i < count; i++) to[i] += a * from[i];
    }
  }
}

/* S = I + a K. */
static void shifted(double *S, const double *K, double a, int nx, int n) {
  for (int column = 0; column < n; column++)
    for (int i = 0; i < nx; i++) S[column * nx + i] = (i == column) + a * K[column * nx + i];
}

static int own_step(const ctmhe_stage *s, const ctmhe_function *f, const call *c, int derivatives) {
  const int nx = NX(s), ny = NY(s), nu = s->nu, n = nx + NW(s) + NP(s), ld = nx + ny, points = POINTS(s);
  const int height = nx + points * ny, nodes = points > 1;
  const double t = *c->arg[0], h = *c->arg[1], *x = c->arg[2], *w = c->arg[3], *p = c->arg[4];
  const double *u0 = c->arg[5], *u1 = c->arg[6];
  double *x_next = c->res[0], *y = c->res[1], *result = derivatives ? c->res[2] : NULL;
  double *k = f->work, *moved = k + nx, *sum = moved + nx, *spare = sum + nx;
  double *J = spare + nx + ny, *S = J + ld * n, *K = S + nx * n, *total = K + nx * n;
  double middle[64];
  if (nu > 64) return 1;
  for (int i = 0; i < nu; i++) middle[i] = (u0[i] + u1[i]) / 2;
  if (derivatives) shifted(S, S, 0.0, nx, n);

  if (f->method == CTMHE_STEP_MAP) {
    const int stays = !(h > 0.0);
    if (f->evaluate(f->model, t, x, u0, w, p, stays ? NULL : x_next, y, derivatives ? J : NULL)) return 1;
    for (int i = 0; stays && i < nx; i++) x_next[i] = x[i];
    for (int column = 0; derivatives && column < n; column++) {
      double *to = result + column * height;
      for (int i = 0; i < nx; i++) to[i] = stays ? i == column : J[column * ld + i];
      for (int i = 0; i < ny; i++) to[nx + i] = J[column * ld + nx + i];
    }
    return 0;
  }

  static const double reach[4] = {0.0, 0.5, 0.5, 1.0}, share[4] = {1.0 / 6, 2.0 / 6, 2.0 / 6, 1.0 / 6};
  for (int i = 0; i < nx; i++) moved[i] = x[i], sum[i] = 0.0;
  for (int i = 0; derivatives && i < nx * n; i++) total[i] = 0.0;
  for (int stage = 0; stage < 4 && (h != 0.0 || nodes); stage++) {
    const double *u = stage == 0 ? u0 : stage == 3 ? u1 : middle;
    if (stage) {
      for (int i = 0; i < nx; i++) moved[i] = x[i] + reach[stage] * h * k[i];
      if (derivatives) shifted(S, K, reach[stage] * h, nx, n);
    }
    double *out = nodes ? y + stage * ny : NULL;
    if (f->evaluate(f->model, t + reach[stage] * h, moved, u, w, p, k, out, derivatives ? J : NULL)) return 1;
    for (int i = 0; i < nx; i++) sum[i] += share[stage] * k[i];
    if (!derivatives) continue;
    if (nodes) follow(J, ld, nx, ny, S, nx, n, result + nx + stage * ny, height);
    follow(J, ld, 0, nx, S, nx, n, K, nx);
    for (int i = 0; i < nx * n; i++) total[i] += share[stage] * K[i];
  }
  for (int i = 0; i < nx; i++) x_next[i] = x[i] + h * sum[i];
  if (derivatives) shifted(S, total, h, nx, n);
  if (f->evaluate(f->model, t + h, x_next, u1, w, p, NULL, y + (points - 1) * ny, derivatives ? J : NULL)) return 1;
  if (derivatives) {
    for (int column = 0; column < n; column++)
      for (int i = 0; i < nx; i++) result[column * height + i] = S[column * nx + i];
    follow(J, ld, nx, ny, S, nx, n, result + nx + (points - 1) * ny, height);
  }
  return 0;
}

#endif
