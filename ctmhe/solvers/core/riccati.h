/* The sweeps over the slots: factorisation backward, step forward, multipliers backward. */
#ifndef CTMHE_RICCATI_H
#define CTMHE_RICCATI_H

#include "dense.h"

/* m += [B A E; 0 0 I]' (q + U'U c) with the value function behind the slot. */
INLINE void pull_back(double *restrict m, const double *restrict U, const double *restrict q, const double *restrict J,
                      const double *restrict c, double *restrict y, int plain, int o, int nx, int nw,
                      int np) {
  const int n = nw + nx + np;
  for (int i = o; i < n; i++) y[i] = q[i];
  if (c && plain) {
    for (int i = o; i < n; i++)
      for (int l = 0; l < nx; l++) y[i] += U[i * n + nw + l] * c[l];
  } else if (c)
    for (int j = o; j < nw + nx; j++) {
      const double t = dot(0.0, U + j * n + nw, c, j < nw ? 0 : j - nw, nx, n);
      for (int i = j; i < n; i++) y[i] += U[j * n + i] * t;
    }
  for (int i = 0; i < nx; i++) {
    const double a = y[nw + i];
    for (int l = 0; l < n; l++) m[l] += a * J[i * n + l];
  }
  for (int i = o; i < nw; i++) m[i] += y[i];
  for (int i = nw + nx; i < n; i++) m[i] += y[i];
}

/* The gradient's part of an elimination: rows of a root are scaled, those of `plain` are not. */
INLINE void forward_eliminate(double *restrict m, const double *restrict U, const double *restrict D, int count, int n,
                              int plain) {
  for (int j = 0; j < count; j++) {
    const double l = m[j] * D[j];
    if (!plain) m[j] = l;
    for (int i = j + 1; i < n; i++) m[i] -= U[j * n + i] * l;
  }
}

/* The variable in front of a slot's flat index: w, x_0 or p, in the order of v. */
INLINE size_t leading(const core *k, int slot, int j, int nx, int nw) {
  return j < nw ? k->fw + (size_t)(slot * nw + j) : j < nw + nx ? (size_t)(j - nw) : k->fp + (size_t)(j - nw - nx);
}

/* Springs and barrier terms at a slot: into M and m, or with `right_hand_side` the forces into m only. */
INLINE void add_forces(core *k, const double *J, double *M, double *m, int slot, int right_hand_side, int nx, int nw,
                       int np) {
  const int n = nw + nx + np, nb = k->nb;
  if (k->bounded) {
    for (int i = 0; i < nx && slot; i++) {
      const size_t at = (size_t)(slot * nx + i);
      if (!k->active[at]) continue;
      if (right_hand_side) {
        m[nw + i] += k->force[at];
      } else {
        k->spring[at] = k->stiffness;
        m[nw + i] += k->z[at] - k->stiffness * (k->active[at] < 0 ? k->low[at] : k->high[at]);
        M[(nw + i) * n + nw + i] += k->stiffness;
      }
    }
    for (int i = 0; i < nb; i++) {
      const size_t at = k->fy + (size_t)(slot * nb + i);
      if (!k->active[at]) continue;
      const double *row = J + (nx + i) * n;
      double force;
      if (right_hand_side) {
        force = k->force[at];
      } else {
        double size = 0.0;
        for (int l = 0; l < n; l++) size += row[l] * row[l];
        const double stiff = size > 0.0 ? k->stiffness / size : 0.0;
        k->spring[at] = stiff;
        force = k->z[at] - stiff * (k->active[at] < 0 ? k->low[at] : k->high[at]);
        for (int a = 0; a < n; a++)
          for (int b = a; b < n; b++) M[a * n + b] += stiff * row[a] * row[b];
      }
      for (int l = 0; l < n; l++) m[l] += row[l] * force;
    }
  }
  if (k->barrier) {
    const double *push = right_hand_side ? k->force : k->barrier_force;
    for (int i = 0; i < nx + nw + (slot ? 0 : np); i++) {
      const size_t at = i < nw || i >= nw + nx ? leading(k, slot, i, nx, nw) : (size_t)(slot * nx + i - nw);
      if (k->active[at]) continue;
      m[i] += push[at];
      if (!right_hand_side) M[i * n + i] += k->barrier_spring[at];
    }
    for (int i = 0; i < nb; i++) {
      const size_t at = k->fy + (size_t)(slot * nb + i);
      const double *row = J + (nx + i) * n, stiff = k->barrier_spring[at];
      if (k->active[at]) continue;
      for (int l = 0; l < n; l++) m[l] += row[l] * push[at];
      if (!right_hand_side && stiff > 0.0)
        for (int a = 0; a < n; a++)
          for (int b = a; b < n; b++) M[a * n + b] += stiff * row[a] * row[b];
    }
  }
  if (!right_hand_side && k->damping > 0.0)
    for (int i = 0; i < (slot ? nw + nx : n); i++) M[i * n + i] += k->damping;
}

/* Move what is held among the `count` leading variables to the right-hand side; their rows become zero. */
INLINE void substitute(const core *k, double *M, double *m, int slot, int count, uint8_t *skip, int nx, int nw, int np) {
  const int n = nw + nx + np;
  for (int j = 0; j < n; j++) skip[j] = 0;
  if (!k->bounded) return;
  for (int j = 0; j < count; j++) {
    const size_t at = leading(k, slot, j, nx, nw);
    if (!k->active[at]) continue;
    const double target = k->active[at] < 0 ? k->low[at] : k->high[at];
    for (int i = 0; i < n; i++) m[i] += (i < j ? M[i * n + j] : M[j * n + i]) * target;
    skip[j] = 1;
  }
  for (int j = 0; j < count; j++)
    if (skip[j]) {
      for (int i = 0; i < j; i++) M[i * n + j] = 0.0;
      for (int i = j; i < n; i++) M[j * n + i] = 0.0;
    }
}

/* Backward sweep from slot `from`: factors and gradients, or with `right_hand_side` the gradients of k->force only.
 * `calm`: nothing is held, pushed or damped. */
INLINE int backward_sized(core *k, const model *m, int from, int right_hand_side, int calm, int nx, int nw, int np) {
  const int n = nw + nx + np, N = k->N, nb = k->nb, plain = k->plain;
  const uint8_t *shared = k->win->shared;
  const size_t nn = (size_t)(n * n);
  uint8_t *skip = (uint8_t *)k->r;
  double *floor = k->t;
  int status = OK;
  if (from >= N) {
    double *U = k->U + (size_t)N * nn, *q = k->q + (size_t)N * (size_t)n;
    for (int i = 0; i < n; i++) q[i] = 0.0;
    if (!right_hand_side) memset(U, 0, sizeof(double) * nn);
    for (int i = 0; i < nx && !calm; i++) {
      const size_t at = (size_t)(N * nx + i);
      double stiff = 0.0;
      if (k->bounded && k->active[at]) {
        if (right_hand_side) {
          q[nw + i] = k->force[at];
        } else {
          stiff = k->spring[at] = k->stiffness;
          q[nw + i] = k->z[at] - stiff * (k->active[at] < 0 ? k->low[at] : k->high[at]);
        }
      }
      if (k->barrier) {
        q[nw + i] += right_hand_side ? (k->active[at] ? 0.0 : k->force[at]) : k->barrier_force[at];
        stiff += k->barrier_spring[at];
      }
      if (!right_hand_side) {
        const double weight = stiff + k->damping;
        U[(nw + i) * n + nw + i] = plain ? weight : sqrt(weight);
      }
    }
    from = N - 1;
  }
  for (int slot = from; slot >= 0; slot--) {
    const int carried = shared[slot] && slot + 1 < N, first = slot == 0 || !shared[slot - 1], o = carried ? 0 : nw;
    double *kept_U = k->U + (size_t)slot * nn, *D = k->D + (size_t)(slot * n), *kept_q = k->q + (size_t)(slot * n);
    SQUARE(U, kept_U);
    WORK(q, kept_q);
    const double *behind = kept_U + nn, *J = m->J + (size_t)(slot * (nx + nb)) * (size_t)n;
    const double *g = m->g + (size_t)(slot * n), *H = m->H + (size_t)slot * nn;
    const int eliminated = slot == 0 ? n : first ? nw : 0, known = right_hand_side || (calm && slot > k->rebuilt);
    for (int i = 0; i < n; i++) q[i] = right_hand_side ? 0.0 : g[i];
    if (known) {
      if (U != kept_U) copy(U, kept_U, nn);
    } else if (WIDE(n)) {
      wide_add(U, H, behind, J, k->S, !plain, o, nx, nw, np);
    } else if (plain) {
      add_plain(U, H, behind, J, k->S, carried, nx, nw, np);
    } else {
      for (size_t i = 0; i < nn; i++) U[i] = H[i];
      transform(k->S, behind, J, o, nx, nw, np);
      add_square(U, k->S + o * n, nw + nx - o, 0, n);
      if (np) add_square(U, behind + (nw + nx) * n, np, nw + nx, n);
    }
    pull_back(q, behind, k->q + (size_t)((slot + 1) * n), J,
              right_hand_side ? NULL : m->c + (size_t)(slot * nx), k->v, plain, o, nx, nw, np);
    if (!calm) add_forces(k, J, U, q, slot, right_hand_side, nx, nw, np);
    if (!known) {
      int outcome;
      if (plain && !WIDE(n)) {
        if (!calm) substitute(k, U, q, slot, eliminated, skip, nx, nw, np);
        outcome = eliminate_plain(U, D, eliminated, n);
      } else {
        for (int i = 0; i < n; i++) floor[i] = PIVOT * U[i * n + i];
        substitute(k, U, q, slot, eliminated, skip, nx, nw, np);
        outcome = plain ? wide_plain(U, D, floor, skip, eliminated, n) : cholesky(U, D, floor, skip, n);
      }
      if (outcome == NOT_A_NUMBER) return outcome;
      if (outcome) status = outcome;
    }
    forward_eliminate(q, U, D, eliminated, n, plain && !WIDE(n));
    if (U != kept_U) {
      for (int i = 0; i < n; i++) kept_q[i] = q[i];
      for (int i = 0; i < n * n && !known; i++) kept_U[i] = U[i];
    }
  }
  return status;
}

/* Whether any bound is held. */
static int any_held(const core *k) {
  uint64_t word, any = 0;
  size_t at = 0;
  if (!k->bounded) return 0;
  for (; at + sizeof word <= k->nf; at += sizeof word) {
    memcpy(&word, k->active + at, sizeof word);
    any |= word;
  }
  for (; at < k->nf; at++) any |= (uint64_t)(k->active[at] != 0);
  return any != 0;
}

static int backward(core *k, const model *m, int from, int right_hand_side) {
  const int nx = NX(k->s), nw = NW(k->s), np = NP(k->s);
  if (right_hand_side) return ESTIMATED(k) ? backward_sized(k, m, from, 1, 0, nx, nw, np)
                                           : backward_sized(k, m, from, 1, 0, nx, nw, 0);
  int status;
  if (k->calm)
    status = ESTIMATED(k) ? backward_sized(k, m, from, 0, 1, nx, nw, np) : backward_sized(k, m, from, 0, 1, nx, nw, 0);
  else
    status = ESTIMATED(k) ? backward_sized(k, m, from, 0, 0, nx, nw, np) : backward_sized(k, m, from, 0, 0, nx, nw, 0);
  k->rebuilt = k->N;
  return status;
}

/* Solve for `count` leading variables of v, those behind them known. */
INLINE void back_substitute(double *restrict v, const double *restrict U, const double *restrict D,
                            const double *restrict l, int count, int n) {
  for (int j = count - 1; j >= 0; j--) {
    v[j] = -dot(l[j], U + j * n, v, j + 1, n, n) * D[j];
  }
}

/* Forward sweep: the step (whole), or a correction added to it. */
INLINE void forward_sized(core *k, const model *m, int correction, int nx, int nw, int np) {
  const int n = nw + nx + np, N = k->N, nb = k->nb;
  const uint8_t *shared = k->win->shared;
  double *d = k->d;
  WORK(v, k->v);
  WORK(next, k->t);
  for (int i = 0; i < n; i++) v[i] = 0.0;
  for (int slot = 0; slot < N; slot++) {
    const double *U = k->U + (size_t)slot * (size_t)(n * n), *D = k->D + (size_t)(slot * n),
                 *q = k->q + (size_t)(slot * n);
    const double *J = m->J + (size_t)(slot * (nx + nb)) * (size_t)n, *c = m->c + (size_t)(slot * nx);
    const int first = slot == 0 || !shared[slot - 1];
    const int eliminated = slot == 0 ? n : first ? nw : 0;
    back_substitute(v, U, D, q, eliminated, n);
    if (!k->calm && k->bounded && eliminated && !correction)
      for (int j = 0; j < eliminated; j++) {
        const size_t at = j < nw ? k->fw + (size_t)(slot * nw + j)
                                 : j < nw + nx ? (size_t)(j - nw) : k->fp + (size_t)(j - nw - nx);
        if (k->active[at]) v[j] = k->active[at] < 0 ? k->low[at] : k->high[at];
      }
    double *dx = d + (size_t)(slot * nx), *dw = d + k->fw + (size_t)(slot * nw), *dy = d + k->fy + (size_t)(slot * nb);
    if (correction) {
      for (int i = 0; i < nw; i++) dw[i] += v[i];
      for (int i = 0; i < nx; i++) dx[i] += v[nw + i];
      if (slot == 0)
        for (int i = 0; i < np; i++) d[k->fp + (size_t)i] += v[nw + nx + i];
    } else {
      for (int i = 0; i < nw; i++) dw[i] = v[i];
      for (int i = 0; i < nx; i++) dx[i] = v[nw + i];
      if (slot == 0)
        for (int i = 0; i < np; i++) d[k->fp + (size_t)i] = v[nw + nx + i];
    }
    for (int i = 0; i < nb; i++) {
      const double t = dot(0.0, J + (nx + i) * n, v, 0, n, n);
      if (correction) dy[i] += t;
      else dy[i] = t;
    }
    for (int i = 0; i < nx; i++) next[i] = dot(correction ? 0.0 : c[i], J + i * n, v, 0, n, n);
    for (int i = 0; i < nx; i++) v[nw + i] = next[i];
  }
  for (int i = 0; i < nx; i++) {
    if (correction) d[N * nx + i] += v[nw + i];
    else d[N * nx + i] = v[nw + i];
  }
}

static void forward(core *k, const model *m, int correction) {
  if (correction) {
    if (ESTIMATED(k)) forward_sized(k, m, 1, NX(k->s), NW(k->s), NP(k->s));
    else forward_sized(k, m, 1, NX(k->s), NW(k->s), 0);
  } else if (ESTIMATED(k)) forward_sized(k, m, 0, NX(k->s), NW(k->s), NP(k->s));
  else forward_sized(k, m, 0, NX(k->s), NW(k->s), 0);
}

/* Adjoint sweep at the step: dynamics multipliers, multipliers of the substituted bounds, predicted decrease of J/2,
 * and how stationary the step is. */
INLINE void adjoint_sized(core *k, const model *m, int nx, int nw, int np) {
  const int n = nw + nx + np, N = k->N, nb = k->nb;
  const uint8_t *shared = k->win->shared;
  const int held = k->bounded && !k->calm;
  WORK(v, k->v);
  WORK(r, k->r);
  WORK(Hv, k->t);
  WORK(rw, k->S);
  WORK(rp, k->S + n);
  WORK(Hp, k->S + 2 * n);
  WORK(gp, k->S + 3 * n);
  const double *d = k->d;
  double slope = 0.0, curvature = 0.0, largest = 0.0, product = 0.0, residual = 0.0, force = 0.0;
  for (int i = 0; i < nw; i++) rw[i] = 0.0;
  for (int i = 0; i < np; i++) {
    rp[i] = k->damping * d[k->fp + (size_t)i];
    Hp[i] = gp[i] = 0.0;
  }
  for (int i = 0; i < nx; i++)
    k->lambda[(N - 1) * nx + i] = k->damping * d[N * nx + i] + (held ? k->z[N * nx + i] : 0.0);
  for (int slot = N - 1; slot >= 0; slot--) {
    const double *H = m->H + (size_t)slot * (size_t)(n * n), *g = m->g + (size_t)(slot * n);
    const double *J = m->J + (size_t)(slot * (nx + nb)) * (size_t)n, *lambda = k->lambda + (size_t)(slot * nx);
    for (int i = 0; i < nw; i++) v[i] = d[k->fw + (size_t)(slot * nw + i)];
    for (int i = 0; i < nx; i++) v[nw + i] = d[(size_t)(slot * nx + i)];
    for (int i = 0; i < np; i++) v[nw + nx + i] = d[k->fp + (size_t)i];
    for (int i = 0; i < n; i++) Hv[i] = 0.0;
    for (int i = 0; i < n; i++) {
      const double vi = v[i], *restrict row = H + i * n;
      Hv[i] += dot(row[i] * vi, row, v, i + 1, n, n);
      for (int j = i + 1; j < n; j++) Hv[j] += row[j] * vi;
    }
    for (int i = 0; i < n; i++) {
      slope += g[i] * v[i];
      curvature += Hv[i] * v[i];
      r[i] = g[i] + Hv[i];
    }
    for (int i = 0; i < nw + nx; i++) {
      const double a = fabs(g[i]), b = fabs(Hv[i]);
      if (a > largest) largest = a;
      if (b > product) product = b;
    }
    for (int i = 0; i < np; i++) Hp[i] += Hv[nw + nx + i], gp[i] += g[nw + nx + i];
    for (int i = 0; i < nx; i++) {
      const double a = lambda[i];
      if (fabs(a) > force) force = fabs(a);
      for (int l = 0; l < n; l++) r[l] += a * J[i * n + l];
    }
    if (k->damping > 0.0)
      for (int i = 0; i < nw + nx; i++) r[i] += k->damping * v[i];
    for (int i = 0; i < nb; i++) {
      const double a = k->z[k->fy + (size_t)(slot * nb + i)];
      if (a != 0.0)
        for (int l = 0; l < n; l++) r[l] += a * J[(nx + i) * n + l];
    }
    for (int i = 0; i < nw; i++) rw[i] += r[i];
    if (slot == 0 || !shared[slot - 1]) {
      for (int i = 0; i < nw; i++) {
        const size_t at = k->fw + (size_t)(slot * nw + i);
        if (held && k->active[at]) k->z[at] = -rw[i];
        else if (fabs(rw[i]) > residual) residual = fabs(rw[i]);
        r[i] = rw[i];
        rw[i] = 0.0;
      }
      /* what rounding left of w's gradient acts on x as in the backward sweep: an unstable model would let it grow */
      const double *U = k->U + (size_t)slot * (size_t)(n * n), *D = k->D + (size_t)(slot * n);
      if (slot) forward_eliminate(r, U, D, nw, n, k->plain && !WIDE(n));
    }
    for (int i = 0; i < np; i++) rp[i] += r[nw + nx + i];
    if (slot == 0) {
      for (int i = 0; i < nx; i++) {
        if (held && k->active[i]) k->z[i] = -r[nw + i];
        else if (fabs(r[nw + i]) > residual) residual = fabs(r[nw + i]);
      }
    } else {
      double *before = k->lambda + (size_t)((slot - 1) * nx);
      if (held)
        for (int i = 0; i < nx; i++) before[i] = r[nw + i] + k->z[slot * nx + i];
      else
        for (int i = 0; i < nx; i++) before[i] = r[nw + i];
    }
  }
  for (int i = 0; i < np; i++) {
    const size_t at = k->fp + (size_t)i;
    if (held && k->active[at]) k->z[at] = -rp[i];
    else if (fabs(rp[i]) > residual) residual = fabs(rp[i]);
    if (fabs(gp[i]) > largest) largest = fabs(gp[i]);
    if (fabs(Hp[i]) > product) product = fabs(Hp[i]);
  }
  if (force > largest) largest = force;
  k->decrease = -(slope + curvature / 2);
  k->curvature = curvature;
  k->optimality = product / (largest > 1e-300 ? largest : 1e-300);
  if (product > largest) largest = product;
  k->stationarity = residual / (largest > 1e-300 ? largest : 1e-300);
}

static void adjoint(core *k, const model *m) {
  if (ESTIMATED(k)) adjoint_sized(k, m, NX(k->s), NW(k->s), NP(k->s));
  else adjoint_sized(k, m, NX(k->s), NW(k->s), 0);
}

#endif
