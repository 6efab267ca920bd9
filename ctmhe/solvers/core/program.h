/* The quadratic program with its bounds: active set, and interior point where that does not settle. */
#ifndef CTMHE_PROGRAM_H
#define CTMHE_PROGRAM_H

#include "riccati.h"

/* Bounds relative to the point, scaled. */
static void relative_bounds(core *k, const model *m) {
  if (k->relative) return;
  k->relative = 1;
  const int nx = NX(k->s), nw = NW(k->s), ny = NY(k->s), q = NQ(k->s), nb = k->nb, np = k->np, N = k->N;
  for (int slot = 0; slot <= N; slot++)
    for (int i = 0; i < nx; i++) {
      const size_t at = (size_t)(slot * nx + i);
      k->low[at] = (k->lower[at] - m->x[at]) * k->inverse[i];
      k->high[at] = (k->upper[at] - m->x[at]) * k->inverse[i];
    }
  for (int slot = 0; slot < N; slot++) {
    for (int i = 0; i < nw; i++) {
      const size_t from = (size_t)(slot * nw + i), at = k->fw + from;
      k->low[at] = (k->lower[at] - m->w[from]) * k->inverse[nx + i];
      k->high[at] = (k->upper[at] - m->w[from]) * k->inverse[nx + i];
    }
    for (int i = 0; i < nb; i++) {
      const size_t at = k->fy + (size_t)(slot * nb + i);
      const double y = m->y[(size_t)((slot * q + q - 1) * ny + i)];
      k->low[at] = (k->lower[at] - y) * k->inverse[nx + nw + i];
      k->high[at] = (k->upper[at] - y) * k->inverse[nx + nw + i];
    }
  }
  for (int i = 0; i < np; i++) {
    const size_t at = k->fp + (size_t)i;
    k->low[at] = (k->lower[at] - m->p[i]) * k->inverse[nx + nw + nb + i];
    k->high[at] = (k->upper[at] - m->p[i]) * k->inverse[nx + nw + nb + i];
  }
}

static double typical_curvature(const core *k, const model *m) {
  const int n = k->n, nv = n - k->np;
  double largest = 0.0;
  for (int slot = 0; slot < k->N; slot++)
    for (int i = 0; i < nv; i++) {
      const double value = fabs(m->H[(size_t)slot * (size_t)(n * n) + (size_t)(i * n + i)]);
      if (value > largest) largest = value;
    }
  for (int i = nv; i < n; i++) {
    double total = 0.0;
    for (int slot = 0; slot < k->N; slot++) total += m->H[(size_t)slot * (size_t)(n * n) + (size_t)(i * n + i)];
    if (fabs(total) > largest) largest = fabs(total);
  }
  return largest > 0.0 ? largest : 1.0;
}

/* Springs against the information that outputs give about states; without any, against all weights. */
static double spring_constant(const core *k, const model *m) {
  const int n = k->n, nw = NW(k->s), nx = NX(k->s), width = nx + k->np;
  double largest = 0.0;
  for (int slot = 0; slot < k->N; slot++)
    for (int i = 0; i < nx; i++) {
      double value = m->H[(size_t)slot * (size_t)(n * n) + (size_t)((nw + i) * (n + 1))];
      if (slot == 0) value -= k->P[i * (width + 1)];
      if (value > largest) largest = value;
    }
  return STIFFNESS * (largest > 0.0 ? largest : typical_curvature(k, m));
}

/* Whether a step breaks a bound; none is held. */
static int breaks_bound(const core *k, const model *m) {
  const int nx = NX(k->s), nw = NW(k->s), ny = NY(k->s), q = NQ(k->s), nb = k->nb, np = k->np, N = k->N;
  const double *d = k->d, *lower = k->lower, *upper = k->upper, limit = 1e-10;
  double worst = 0.0;
#define BREAKS(at, value, inverse)                                                                      \
  do {                                                                                                  \
    const double low = (lower[at] - (value)) * (inverse) - d[at], high = d[at] - (upper[at] - (value)) * (inverse); \
    worst = low > worst ? low : worst;                                                                  \
    worst = high > worst ? high : worst;                                                                \
  } while (0)
  for (int slot = 0; slot <= N; slot++)
    for (int i = 0; i < nx; i++) BREAKS(slot * nx + i, m->x[slot * nx + i], k->inverse[i]);
  d += k->fw, lower += k->fw, upper += k->fw;
  for (int slot = 0; slot < N; slot++)
    for (int i = 0; i < nw; i++) BREAKS(slot * nw + i, m->w[slot * nw + i], k->inverse[nx + i]);
  d += k->fy - k->fw, lower += k->fy - k->fw, upper += k->fy - k->fw;
  for (int slot = 0; slot < N; slot++)
    for (int i = 0; i < nb; i++) BREAKS(slot * nb + i, m->y[(slot * q + q - 1) * ny + i], k->inverse[nx + nw + i]);
  d += k->fp - k->fy, lower += k->fp - k->fy, upper += k->fp - k->fy;
  for (int i = 0; i < np; i++) BREAKS(i, m->p[i], k->inverse[nx + nw + nb + i]);
#undef BREAKS
  return worst > limit;
}

/* Whether a held bound is a spring (else it is substituted). */
static int sprung(const core *k, size_t at) {
  return (at >= (size_t)NX(k->s) && at < k->fw) || (at >= k->fy && at < k->fp);
}

static int slot_of(const core *k, size_t at) {
  if (at < k->fw) return (int)(at / (size_t)NX(k->s));
  if (at < k->fy) return (int)((at - k->fw) / (size_t)NW(k->s));
  if (at < k->fp) return (int)((at - k->fy) / (size_t)k->nb);
  return 0;
}

/* Minimise with the held bounds; slots behind `from` still have their factors. */
static int equality_constrained(core *k, const model *m, int from) {
  const size_t nx = (size_t)NX(k->s);
  k->calm = !(k->barrier || k->damping > 0.0 || any_held(k));
  if (!k->calm && k->bounded) {
    relative_bounds(k, m);
    if (k->stiffness == 0.0) k->stiffness = spring_constant(k, m);
  }
  for (int attempt = 0; attempt < 4; attempt++) {
    int status = backward(k, m, from, 0);
    if (status) return status;
    forward(k, m, 0);
    if (k->calm || !k->bounded) {
      adjoint(k, m);
      return k->stationarity == k->stationarity ? OK : NOT_A_NUMBER;
    }
    double before = 0.0;
    int met = 0, slow = 0;
    for (int round = 0; round <= MAX_CORRECTIONS; round++) {
      double worst = 0.0, stiffest = 0.0;
      for (size_t at = nx; at < k->fp; at++) {
        if (at == k->fw) at = k->fy;
        if (at >= k->fp) break;
        k->force[at] = 0.0;
        if (!k->active[at]) continue;
        const double bound = k->active[at] < 0 ? k->low[at] : k->high[at], error = k->d[at] - bound;
        k->force[at] = k->spring[at] * error;
        k->z[at] += k->force[at];
        const double relative = fabs(error) / (1.0 + fabs(bound));
        if (!(relative <= worst)) worst = relative;
        stiffest = 1.0;
      }
      if (worst != worst) return NOT_A_NUMBER;
      if (stiffest == 0.0 || worst <= HELD) {
        met = 1;
        break;
      }
      if (round > 1 && worst > 0.3 * before) {
        slow = 1;
        break;
      }
      before = worst;
      backward(k, m, k->N, 1);
      forward(k, m, 1);
    }
    if (met) {
      adjoint(k, m);
      return k->stationarity == k->stationarity ? OK : NOT_A_NUMBER;
    }
    if (slow && before < 1e-9) { /* at the level of rounding */
      adjoint(k, m);
      return OK;
    }
    k->stiffness *= 1e2;
    from = k->N;
  }
  return INCONSISTENT;
}

static uint64_t hash(const int8_t *set, size_t length) {
  uint64_t h = 1469598103934665603u;
  for (size_t i = 0; i < length; i++) h = (h ^ (uint8_t)(set[i] + 1)) * 1099511628211u;
  return h;
}

/* The next active set into k->candidate, with the single worst change into k->cautious; returns whether any. */
static int update(core *k) {
  double size = 0.0, worst = 0.0;
  size_t index = 0;
  int8_t value = 0;
  int changed = 0;
  for (size_t at = 0; at < k->nf; at++)
    if (k->active[at] && fabs(k->z[at]) > size) size = fabs(k->z[at]);
  memcpy(k->cautious, k->active, k->nf);
  for (size_t at = 0; at < k->nf; at++) {
    const int8_t held = k->active[at];
    const double low = k->low[at] - k->d[at], high = k->d[at] - k->high[at];
    int8_t target = 0;
    if (!held && !(low > 1e-10) && !(high > 1e-10) && !k->fixed[at]) {
      k->candidate[at] = 0;
      continue;
    }
    if (k->fixed[at]) target = 1;
    else if (held) target = held * k->z[at] > -1e-9 * size ? held : 0;
    else if (high > 1e-10) target = 1;
    else target = -1;
    k->candidate[at] = target;
    if (target == held) continue;
    const double badness = k->fixed[at] ? HUGE_VAL
                           : held       ? -held * k->z[at] / (size > 1e-300 ? size : 1e-300)
                           : low > high ? low
                                        : high;
    if (!changed || badness > worst) worst = badness, index = at, value = target;
    changed = 1;
  }
  if (changed) k->cautious[index] = value;
  return changed;
}

/* Largest slot at which two sets differ, N when the last edge does; multipliers of dropped bounds are cleared. */
static int adopt(core *k, const int8_t *set) {
  int last = 0;
  for (size_t at = 0; at < k->nf; at++) {
    if (set[at] == k->active[at]) continue;
    const int slot = slot_of(k, at);
    if (slot > last) last = slot;
    k->z[at] = 0.0;
    k->active[at] = set[at];
  }
  return last;
}

/* Largest step for which slacks and multipliers keep their sign; `ds`, `dz` follow from the step of d. */
static double step_to_boundary(const core *k, double *complementarity, double alpha_given, double *count) {
  double alpha = 1.0, total = 0.0, number = 0.0;
  const int measure = alpha_given > 0.0;
  for (size_t at = 0; at < k->nf; at++) {
    if (k->active[at]) continue;
    for (int side = 0; side < 2; side++) {
      const double bound = side ? k->high[at] : k->low[at], s = side ? k->s_high[at] : k->s_low[at];
      const double z = side ? k->z_high[at] : k->z_low[at];
      if (!(fabs(bound) < HUGE_VAL)) continue;
      const double ds = (side ? bound - k->d[at] : k->d[at] - bound) - s;
      const double centre = side ? k->barrier_force[k->nf + at] : k->barrier_force[2 * k->nf + at];
      const double dz = centre - z - z / s * ds;
      if (measure) {
        total += (s + alpha_given * ds) * (z + alpha_given * dz);
        number += 1.0;
      } else {
        if (s + alpha * ds < 0.0) alpha = -s / ds;
        if (z + alpha * dz < 0.0) alpha = -z / dz;
      }
    }
  }
  if (measure) {
    *complementarity = total / (number > 0.0 ? number : 1.0);
    *count = number;
  }
  return alpha;
}

/* Mehrotra's predictor-corrector on all bounds that are not equalities; leaves the active set it finds. */
static int interior_point(core *k, const model *m, int *factorizations) {
  const size_t nf = k->nf;
  double *centre_high = k->barrier_force + nf, *centre_low = centre_high + nf;
  const double curvature = spring_constant(k, m) / STIFFNESS;
  relative_bounds(k, m);
  k->calm = 0;
  k->stiffness = STIFFNESS * curvature;
  for (size_t at = 0; at < nf; at++) {
    k->active[at] = k->fixed[at] ? 1 : 0;
    k->z[at] = k->barrier_spring[at] = k->barrier_force[at] = 0.0;
    if (!(k->low[at] <= k->high[at])) return INCONSISTENT;
  }
  k->barrier = 0;
  int status = backward(k, m, k->N, 0);
  *factorizations += 1;
  if (status) return status;
  forward(k, m, 0);
  double violation = 0.0;
  for (size_t at = 0; at < nf; at++) {
    if (k->low[at] - k->d[at] > violation) violation = k->low[at] - k->d[at];
    if (k->d[at] - k->high[at] > violation) violation = k->d[at] - k->high[at];
  }
  const double least = 0.1 * (violation > 1e-3 ? violation : 1e-3), scale = curvature * least * least;
  for (size_t at = 0; at < nf; at++) {
    const double low = k->d[at] - k->low[at], high = k->high[at] - k->d[at];
    k->s_low[at] = low > least ? low : least;
    k->s_high[at] = high > least ? high : least;
    k->z_low[at] = low < HUGE_VAL ? scale / k->s_low[at] : 0.0;
    k->z_high[at] = high < HUGE_VAL ? scale / k->s_high[at] : 0.0;
  }
  k->barrier = 1;
  status = INCONSISTENT;
  for (int iteration = 0; iteration < MAX_BARRIER; iteration++) {
    double mu = 0.0, count = 0.0, infeasible = 0.0;
    for (size_t at = 0; at < nf; at++) {
      k->start[at] = k->d[at];
      k->barrier_spring[at] = k->barrier_force[at] = centre_low[at] = centre_high[at] = 0.0;
      if (k->active[at]) continue;
      if (k->low[at] > -HUGE_VAL) {
        const double stiff = k->z_low[at] / k->s_low[at];
        const double gap = fabs(k->d[at] - k->low[at] - k->s_low[at]);
        if (gap > infeasible) infeasible = gap;
        k->barrier_spring[at] += stiff;
        k->barrier_force[at] -= k->z_low[at] + stiff * k->low[at];
        mu += k->z_low[at] * k->s_low[at], count += 1.0;
      }
      if (k->high[at] < HUGE_VAL) {
        const double stiff = k->z_high[at] / k->s_high[at];
        const double gap = fabs(k->high[at] - k->d[at] - k->s_high[at]);
        if (gap > infeasible) infeasible = gap;
        k->barrier_spring[at] += stiff;
        k->barrier_force[at] += k->z_high[at] - stiff * k->high[at];
        mu += k->z_high[at] * k->s_high[at], count += 1.0;
      }
    }
    if (count == 0.0) {
      status = OK;
      break;
    }
    mu /= count;
    if (!(mu < HUGE_VAL)) break;
    if (iteration && mu <= INTERIOR * curvature && infeasible <= 1e-10) {
      status = OK;
      break;
    }
    *factorizations += 1;
    const int outcome = backward(k, m, k->N, 0);
    if (outcome) {
      status = outcome;
      break;
    }
    forward(k, m, 0);
    double affine = 0.0;
    double alpha = step_to_boundary(k, NULL, 0.0, NULL);
    step_to_boundary(k, &affine, alpha, &count);
    const double ratio = affine / mu, sigma = ratio > 0.0 ? ratio * ratio * ratio : 0.0;
    const double target = (sigma < 1.0 ? sigma : 1.0) * mu;
    for (size_t at = 0; at < nf; at++) {
      k->force[at] = 0.0;
      if (k->active[at]) continue;
      if (k->low[at] > -HUGE_VAL) {
        const double s = k->s_low[at], z = k->z_low[at], ds = k->d[at] - k->low[at] - s, dz = -z - z / s * ds;
        centre_low[at] = (target - ds * dz) / s;
        k->force[at] -= centre_low[at];
      }
      if (k->high[at] < HUGE_VAL) {
        const double s = k->s_high[at], z = k->z_high[at], ds = k->high[at] - k->d[at] - s, dz = -z - z / s * ds;
        centre_high[at] = (target - ds * dz) / s;
        k->force[at] += centre_high[at];
      }
    }
    backward(k, m, k->N, 1);
    forward(k, m, 1);
    alpha = step_to_boundary(k, NULL, 0.0, NULL);
    if (!(alpha > 1e-12)) break;
    if (alpha < 1.0) alpha *= 0.995;
    for (size_t at = 0; at < nf; at++) {
      if (k->active[at]) {
        k->z[at] += k->spring[at] * (k->d[at] - k->high[at]) * (sprung(k, at) ? 1.0 : 0.0);
      } else {
        if (k->low[at] > -HUGE_VAL) {
          const double s = k->s_low[at], z = k->z_low[at], ds = k->d[at] - k->low[at] - s;
          k->s_low[at] += alpha * ds;
          k->z_low[at] += alpha * (centre_low[at] - z - z / s * ds);
        }
        if (k->high[at] < HUGE_VAL) {
          const double s = k->s_high[at], z = k->z_high[at], ds = k->high[at] - k->d[at] - s;
          k->s_high[at] += alpha * ds;
          k->z_high[at] += alpha * (centre_high[at] - z - z / s * ds);
        }
      }
      k->d[at] = k->start[at] + alpha * (k->d[at] - k->start[at]);
    }
  }
  k->barrier = 0;
  if (status) return status;
  for (size_t at = 0; at < nf; at++) {
    if (k->fixed[at]) continue;
    const int low = k->low[at] > -HUGE_VAL && k->z_low[at] > curvature * k->s_low[at];
    const int high = k->high[at] < HUGE_VAL && k->z_high[at] > curvature * k->s_high[at];
    k->active[at] = (int8_t)(low && !(high && k->z_high[at] > k->z_low[at]) ? -1 : high);
    k->z[at] = k->active[at] < 0 ? -k->z_low[at] : k->active[at] > 0 ? k->z_high[at] : 0.0;
  }
  return OK;
}

/* The active set method from the set at hand. */
static int active_set(core *k, const model *m, int *factorizations) {
  uint64_t seen[MAX_CHANGES];
  int count = 0, single = 0, have_cautious = 0, from = k->N;
  for (int pass = 0; pass < MAX_CHANGES; pass++) {
    *factorizations += 1;
    const double stiffness = k->stiffness;
    const int status = equality_constrained(k, m, from);
    if (status == INDEFINITE || status == NOT_A_NUMBER) return status;
    if (status) { /* held bounds that depend on each other */
      if (single || !have_cautious) return status;
      single = 1;
      k->stiffness = stiffness;
      memcpy(k->candidate, k->cautious, k->nf);
      adopt(k, k->candidate);
      for (size_t at = 0; at < k->nf; at++) k->z[at] = 0.0;
      from = k->N;
      continue;
    }
    if (k->calm) {
      if (!breaks_bound(k, m)) return OK;
      relative_bounds(k, m);
    }
    if (!update(k)) return OK;
    const uint64_t key = hash(k->candidate, k->nf);
    for (int i = 0; i < count && !single; i++) single = seen[i] == key;
    seen[count++] = key;
    have_cautious = 1;
    if (single && ++single > MAX_SINGLE) break;
    adopt(k, single ? k->cautious : k->candidate);
  }
  return INCONSISTENT;
}

/* Solve the quadratic program at m: active set, and where that does not settle, interior point and active set. */
static int solve_program(core *k, const model *m, int *factorizations) {
  k->barrier = 0;
  if (!k->bounded) {
    *factorizations += 1;
    return equality_constrained(k, m, k->N);
  }
  int status = active_set(k, m, factorizations);
  if (status != INCONSISTENT) return status;
  status = interior_point(k, m, factorizations);
  if (status) return status;
  memcpy(k->kept, k->active, k->nf); /* the point itself, should its set have bounds that depend on each other */
  copy(k->s_low, k->d, k->nf);
  copy(k->s_high, k->z, k->nf);
  status = active_set(k, m, factorizations);
  if (status != INCONSISTENT) return status;
  memcpy(k->active, k->kept, k->nf);
  copy(k->d, k->s_low, k->nf);
  copy(k->z, k->s_high, k->nf);
  k->calm = 0; /* the last pass may have held nothing; this set may */
  adjoint(k, m);
  return OK;
}

#endif
