/* The model: evaluation, linearisation with Gauss-Newton blocks, second derivatives. */
#ifndef CTMHE_MODEL_H
#define CTMHE_MODEL_H

#include "slot.h"

/* A slot at a point, for evaluation; the results go to one lane. */
INLINE slot_call slot_at(const core *k, const model *m, int slot, int lane, int derivatives) {
  const ctmhe_stage *s = k->s;
  const ctmhe_window *win = k->win;
  const size_t i = (size_t)slot, nx = (size_t)NX(s), nw = (size_t)NW(s), nu = (size_t)s->nu;
  const size_t qy = (size_t)(NQ(s) * NY(s)), n0 = nx + nw + (size_t)NP(s);
  double *to = k->lane + (size_t)lane * (nx + qy + (nx + qy) * n0);
  const slot_call c = {win->t[i], win->h[i], m->x + i * nx, m->w + i * nw, m->p, win->u0 + i * nu, win->u1 + i * nu,
                       to, to + nx, derivatives ? to + nx + qy : NULL};
  return c;
}

/* Evaluate slots from `first` on, as many as there are lanes. Returns nonzero on failure. */
static int evaluate(const core *k, const ctmhe_function *f, const model *m, int first, int lanes, int derivatives) {
  slot_call calls[BATCH];
  for (int l = 0; l < lanes; l++) calls[l] = slot_at(k, m, first + l, l, derivatives);
  return evaluate_slots(k->s, f, calls, lanes, k->steps);
}

/* The rows of L_y J_y of one evaluation point, and the residual; returns the number of rows. */
INLINE int weighted_rows(const core *k, int slot, int point, const double *y, const double *jacobian, double *rows,
                         double *residual, int nx, int nw, int np, int all) {
  const int ny = NY(k->s), q = NQ(k->s), n = nw + nx + np, height = nx + q * ny;
  const size_t at = (size_t)(slot * q + point);
  const double *L = k->win->L_y + at * (size_t)(ny * ny), *data = k->win->y_data + at * (size_t)ny;
  const int kind = k->kind_y[at];
  int used = 0;
  (void)all;
  for (int r = 0; r < ny; r++) {
    const int first = kind == DENSE ? 0 : r, last = kind == DENSE ? ny : r + 1;
    double res = 0.0, any = 0.0;
    for (int j = first; j < last; j++) {
      res += L[r * ny + j] * (y[j] - data[j]);
      any += fabs(L[r * ny + j]);
    }
    if (any == 0.0) continue;
    residual[used] = res;
    if (jacobian) {
      double *row = rows + used * n;
      for (int c = 0; c < n; c++) row[c] = 0.0;
      for (int j = first; j < last; j++) {
        const double l = L[r * ny + j];
        if (l == 0.0) continue;
        const double *source = jacobian + nx + point * ny + j;
        for (int c = 0; c < nw; c++) row[c] += l * source[(nx + c) * height];
        for (int c = 0; c < nx; c++) row[nw + c] += l * source[c * height];
        for (int c = 0; c < np; c++) row[nw + nx + c] += l * source[(nx + nw + c) * height];
      }
      for (int c = 0; c < n; c++) row[c] *= k->scale[c];
    }
    used++;
  }
  return used;
}

/* Cost, defects and, with `jacobian`, the linearised problem at m's point. Returns nonzero when the model fails. */
INLINE int linearize_sized(core *k, model *m, int with_jacobian, int nx, int nw, int np) {
  const ctmhe_stage *s = k->s;
  const ctmhe_window *win = k->win;
  const int N = k->N, ny = NY(s), q = NQ(s), n = nw + nx + np, nb = k->nb, height = nx + q * ny, all = NP(s);
  const int width = nx + np; /* of the prior */
  const ctmhe_function *f = with_jacobian ? &s->jacobian : &s->value;
  const uint8_t *stale = with_jacobian ? k->stale : NULL;
  double total = 0.0, all_infeasible = 0.0, largest_defect = 0.0, largest_excess = 0.0;
  double *scaled_w = k->v;
  for (int i = 0; i < width; i++) { /* prior */
    double r = 0.0;
    for (int j = 0; j < width; j++)
      r += win->L_prior[i * width + j] * ((j < nx ? m->x[j] : m->p[j - nx]) - win->prior[j]);
    total += r * r;
  }
  const int lanes = lanes_of(f), qy = q * ny, lane_size = nx + qy + (nx + qy) * (nx + nw + all);
  for (int slot = 0; slot < N; slot++) {
    const int lane = slot % lanes;
    double *parts = m->parts + 4 * slot, cost = 0.0, infeasibility = 0.0, defect = 0.0, excess = 0.0, finite = 0.0;
    if (lane == 0) {
      const int count = N - slot < lanes ? N - slot : lanes;
      if ((!stale || memchr(stale + slot, 1, (size_t)count)) && evaluate(k, f, m, slot, count, with_jacobian)) return 1;
    }
    if (stale && !stale[slot]) {
      total += parts[0], all_infeasible += parts[1];
      if (parts[2] > largest_defect) largest_defect = parts[2];
      if (parts[3] > largest_excess) largest_excess = parts[3];
      continue;
    }
    const double *reached = k->lane + lane * lane_size, *y = reached + nx, *jacobian = y + qy;
    const double *next = m->x + (size_t)(slot + 1) * (size_t)nx;
    double *c = m->c + (size_t)slot * (size_t)nx;
    for (int i = 0; i < nx; i++) {
      c[i] = (reached[i] - next[i]) * k->inverse_x[i];
      const double size = fabs(c[i]);
      infeasibility += size;
      if (size > defect) defect = size;
    }
    double *kept = m->y + (size_t)slot * (size_t)(q * ny);
    for (int i = 0; i < q * ny; i++) {
      kept[i] = y[i];
      finite += y[i] * 0.0;
    }
    if (nb) {
      const double *end = y + (q - 1) * ny, *low = win->y_lower + (size_t)slot * (size_t)ny,
                   *high = win->y_upper + (size_t)slot * (size_t)ny;
      for (int i = 0; i < ny; i++) {
        double over = 0.0;
        if (low[i] - end[i] > over) over = low[i] - end[i];
        if (end[i] - high[i] > over) over = end[i] - high[i];
        over /= win->y_scale[i];
        infeasibility += over;
        if (over > excess) excess = over;
      }
    }
    const double *w = m->w + (size_t)slot * (size_t)nw, *W = k->W + (size_t)slot * (size_t)(nw * nw);
    double *H = m->H + (size_t)slot * (size_t)(n * n), *g = m->g + (size_t)slot * (size_t)n;
    if (stale) {
      copy(k->before, H, (size_t)(n * n));
      copy(k->before + n * n, m->J + (size_t)slot * (size_t)((nx + nb) * n), (size_t)((nx + nb) * n));
    }
    if (with_jacobian) {
      memset(H, 0, sizeof(double) * (size_t)(n * n));
      memset(g, 0, sizeof(double) * (size_t)n);
    }
    for (int i = 0; i < nw; i++) scaled_w[i] = w[i] * k->inverse[nx + i];
    const int dense_w = k->kind_w[slot] == DENSE;
    for (int i = 0; i < nw; i++) {
      double force = 0.0;
      if (dense_w)
        for (int j = 0; j < nw; j++) force += W[i * nw + j] * scaled_w[j];
      else
        force = W[i * nw + i] * scaled_w[i];
      cost += scaled_w[i] * force;
      if (with_jacobian) {
        g[i] = force;
        if (dense_w)
          for (int j = i; j < nw; j++) H[i * n + j] = W[i * nw + j];
        else
          H[i * n + i] = W[i * nw + i];
      }
    }
    for (int point = 0; point < q; point++) {
      if (k->kind_y[slot * q + point] == ZERO) continue;
      const int used = weighted_rows(k, slot, point, y + point * ny, with_jacobian ? jacobian : NULL, k->rows,
                                     k->residual, nx, nw, np, all);
      for (int r = 0; r < used; r++) cost += k->residual[r] * k->residual[r];
      if (!with_jacobian) continue;
      for (int r = 0; r < used; r++) {
        const double *restrict row = k->rows + r * n;
        const double res = k->residual[r];
        for (int i = 0; i < n; i++) {
          const double a = row[i];
          if (a == 0.0) continue;
          double *restrict target = H + i * n;
          g[i] += a * res;
          for (int j = i; j < n; j++) target[j] += a * row[j];
        }
      }
    }
    parts[0] = cost + finite, parts[1] = infeasibility, parts[2] = defect, parts[3] = excess;
    total += parts[0], all_infeasible += infeasibility;
    if (defect > largest_defect) largest_defect = defect;
    if (excess > largest_excess) largest_excess = excess;
    if (!with_jacobian) continue;
    double *restrict J = m->J + (size_t)slot * (size_t)((nx + nb) * n);
    for (int i = 0; i < nx; i++) {
      const double *source = jacobian + i, *factor = k->factor + i * n;
      double *row = J + i * n;
      for (int j = 0; j < nw; j++) row[j] = source[(nx + j) * height] * factor[j];
      for (int j = 0; j < nx; j++) row[nw + j] = source[j * height] * factor[nw + j];
      for (int j = 0; j < np; j++) row[nw + nx + j] = source[(nx + nw + j) * height] * factor[nw + nx + j];
    }
    for (int i = 0; i < nb; i++) {
      const double *source = jacobian + nx + (q - 1) * ny + i;
      const double back = 1.0 / win->y_scale[i];
      double *row = J + (nx + i) * n;
      for (int j = 0; j < nw; j++) row[j] = source[(nx + j) * height] * back;
      for (int j = 0; j < nx; j++) row[nw + j] = source[j * height] * back;
      for (int j = 0; j < np; j++) row[nw + nx + j] = source[(nx + nw + j) * height] * back;
      for (int j = 0; j < n; j++) row[j] *= k->scale[j];
    }
    if (slot == 0) {
      double *deviation = k->t;
      for (int i = 0; i < width; i++)
        deviation[i] = ((i < nx ? m->x[i] : m->p[i - nx]) - win->prior[i]) / k->scale[nw + i];
      for (int i = 0; i < width; i++)
        for (int j = 0; j < width; j++) {
          g[nw + i] += k->P[i * width + j] * deviation[j];
          if (j >= i) H[(nw + i) * n + nw + j] += k->P[i * width + j];
        }
    }
    if (stale && (memcmp(k->before, H, sizeof(double) * (size_t)(n * n)) ||
                  memcmp(k->before + n * n, J, sizeof(double) * (size_t)((nx + nb) * n))))
      k->rebuilt = slot;
  }
  m->cost = total;
  m->infeasibility = all_infeasible;
  m->defect = largest_defect;
  m->excess = largest_excess;
  return 0;
}

static int linearize(core *k, model *m) {
  if (ESTIMATED(k)) return linearize_sized(k, m, 1, NX(k->s), NW(k->s), NP(k->s));
  return linearize_sized(k, m, 1, NX(k->s), NW(k->s), 0);
}

static int assess(core *k, model *m) {
  return linearize_sized(k, m, 0, NX(k->s), NW(k->s), ESTIMATED(k) ? NP(k->s) : 0);
}

/* Add the second derivatives of the Lagrangian to H. */
static int add_curvature(core *k, model *m) {
  const ctmhe_stage *s = k->s;
  const int nx = NX(s), nw = NW(s), n = k->n, ny = NY(s), q = NQ(s), n0 = nx + nw + NP(s);
  double *lambda_x = k->t, *lambda_y = k->rows, *residual = k->residual;
  for (int slot = 0; slot < k->N; slot++) {
    for (int i = 0; i < nx; i++) lambda_x[i] = k->lambda[slot * nx + i] * k->inverse_x[i];
    for (int point = 0; point < q; point++) {
      const size_t at = (size_t)(slot * q + point);
      const double *L = k->win->L_y + at * (size_t)(ny * ny), *data = k->win->y_data + at * (size_t)ny;
      const double *y = m->y + at * (size_t)ny;
      for (int r = 0; r < ny; r++) {
        residual[r] = 0.0;
        for (int j = 0; j < ny; j++) residual[r] += L[r * ny + j] * (y[j] - data[j]);
      }
      for (int j = 0; j < ny; j++) {
        double total = 0.0;
        for (int r = 0; r < ny; r++) total += L[r * ny + j] * residual[r];
        lambda_y[point * ny + j] = total;
      }
    }
    for (int i = 0; i < k->nb; i++)
      lambda_y[(q - 1) * ny + i] += k->z[k->fy + (size_t)(slot * k->nb + i)] / k->win->y_scale[i];
    const slot_call call = slot_at(k, m, slot, 0, 1);
    if (slot_curvature(s, &call, lambda_x, lambda_y, k->second)) return 1;
    double *H = m->H + (size_t)slot * (size_t)(n * n);
    for (int i = 0; i < n; i++) {
      const int from = i < nw ? nx + i : i < nw + nx ? i - nw : i;
      for (int j = i; j < n; j++) {
        const int to = j < nw ? nx + j : j < nw + nx ? j - nw : j;
        H[i * n + j] += k->second[from + to * n0] * k->scale[i] * k->scale[j];
      }
    }
  }
  return 0;
}

#endif
