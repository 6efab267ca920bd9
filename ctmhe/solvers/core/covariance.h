/* The covariance of (x at the window's end, estimated p): a forward sweep with the factors of the backward one.
 *
 * The factors are a Gaussian read backward: slot 0 has (w, x, p) = U^-1 xi, and every later slot that brings a w of its
 * own has w = G (x, p) + U_ww^-1 xi with G = -U_ww^-1 U_w(xp). Active bounds are ignored. A pivot of zero adds nothing,
 * which leaves the variances of determined signals as they are. Directions that the window says nothing about are told
 * apart as in gauss_newton.py: their variance grows when a small regularisation shrinks.
 */
#ifndef CTMHE_COVARIANCE_H
#define CTMHE_COVARIANCE_H

#include "riccati.h"

#define SMALL_DAMPING 1e-13
#define LARGE_DAMPING 1e-12
#define DETERMINED 1e6   /* variances up to this, times the signal's curvature, need no closer look */
#define INVOLVED 1e-5    /* component of an undetermined direction from which a signal's variance is infinite */
#define MAX_SWEEPS 40    /* of Jacobi rotations */

static void prepare(core *k, const ctmhe_result *guess);

/* Largest curvature of each variable over the slots; of the parameters, the sum. */
static void curvatures(const core *k, const model *m, double *h) {
  const int n = k->n, nv = n - k->np;
  for (int i = 0; i < n; i++) {
    h[i] = 0.0;
    for (int slot = 0; slot < k->N; slot++) {
      const double value = m->H[((size_t)slot * (size_t)n + (size_t)i) * (size_t)n + (size_t)i];
      if (i >= nv) h[i] += value;
      else if (value > h[i]) h[i] = value;
    }
    if (!(h[i] > 0.0)) h[i] = 1.0;
  }
}

/* Factors without bounds and gradients, damping * h on the diagonal; INCONSISTENT: with an eliminated pivot of zero. */
static int factorize(core *k, const model *m, const double *h, double damping) {
  const int nx = NX(k->s), nw = NW(k->s), np = k->np, n = k->n, N = k->N;
  const uint8_t *shared = k->win->shared;
  const size_t nn = (size_t)n * (size_t)n;
  double *floor = k->t;
  uint8_t *skip = (uint8_t *)k->r;
  int status = OK;
  memset(skip, 0, (size_t)n);
  memset(k->U + (size_t)N * nn, 0, sizeof(double) * nn);
  for (int i = nw; i < nw + nx; i++) k->U[(size_t)N * nn + (size_t)(i * n + i)] = sqrt(damping * h[i]);
  for (int slot = N - 1; slot >= 0; slot--) {
    const int o = shared[slot] && slot + 1 < N ? 0 : nw, first = slot == 0 || !shared[slot - 1];
    const int eliminated = slot == 0 ? n : first ? nw : 0;
    double *U = k->U + (size_t)slot * nn, *D = k->D + (size_t)slot * (size_t)n;
    const double *H = m->H + (size_t)slot * nn, *behind = U + nn;
    const double *J = m->J + (size_t)(slot * (nx + k->nb)) * (size_t)n;
    if (WIDE(n)) {
      wide_add(U, H, behind, J, k->S, 1, o, nx, nw, np);
    } else {
      copy(U, H, nn);
      transform(k->S, behind, J, o, nx, nw, np);
      add_square(U, k->S + o * n, nw + nx - o, 0, n);
      if (np) add_square(U, behind + (nw + nx) * n, np, nw + nx, n);
    }
    for (int i = 0; i < n; i++) {
      if (i < nw + nx || slot == 0) U[i * n + i] += damping * h[i];
      floor[i] = damping > 0.0 ? 0.0 : PIVOT * U[i * n + i];
    }
    if (cholesky(U, D, floor, skip, n) == NOT_A_NUMBER) return NOT_A_NUMBER;
    for (int i = 0; i < eliminated; i++)
      if (D[i] == 0.0) status = INCONSISTENT;
  }
  return status;
}

/* Z = U^-1 [I  -U_rest] for the first `count` variables: rows of the noise on them, then of their gain on the others. */
static void noise_and_gain(double *Z, const double *U, const double *D, int count, int n) {
  for (int j = count - 1; j >= 0; j--) {
    double *row = Z + j * n;
    for (int l = 0; l < n; l++) row[l] = l == j ? 1.0 : l < count ? 0.0 : -U[j * n + l];
    for (int i = j + 1; i < count; i++)
      for (int l = i; l < n; l++) row[l] -= U[j * n + i] * Z[i * n + l];
    for (int l = j; l < n; l++) row[l] *= D[j];
  }
}

/* Forward sweep: the covariance of scaled (x_N, p), m x m. */
static void propagate(core *k, const model *m, double *covariance) {
  const int nx = NX(k->s), nw = NW(k->s), np = k->np, n = k->n, N = k->N, width = nx + np;
  const uint8_t *shared = k->win->shared;
  double *C = k->S, *Z = C + n * n, *Y = Z + n * n; /* C: covariance of (w, x, p), both triangles */
  for (int slot = 0; slot < N; slot++) {
    const double *U = k->U + (size_t)slot * (size_t)(n * n), *D = k->D + (size_t)(slot * n);
    const double *J = m->J + (size_t)(slot * (nx + k->nb)) * (size_t)n;
    const int first = slot == 0 || !shared[slot - 1], count = slot == 0 ? n : first ? nw : 0;
    noise_and_gain(Z, U, D, count, n);
    for (int i = 0; i < count; i++) { /* cross covariance with what is there: G C */
      double *row = C + i * n;
      for (int l = count; l < n; l++) row[l] = 0.0;
      for (int j = count; j < n; j++)
        for (int l = count; l < n; l++) row[l] += Z[i * n + j] * C[j * n + l];
    }
    for (int i = 0; i < count; i++)
      for (int l = i; l < count; l++) {
        double total = 0.0;
        for (int j = l; j < count; j++) total += Z[i * n + j] * Z[l * n + j];
        for (int j = count; j < n; j++) total += C[i * n + j] * Z[l * n + j];
        C[i * n + l] = C[l * n + i] = total;
      }
    for (int i = 0; i < count; i++)
      for (int l = count; l < n; l++) C[l * n + i] = C[i * n + l];
    for (int i = 0; i < nx; i++) { /* Y = [B A E] C */
      double *row = Y + i * n;
      for (int l = 0; l < n; l++) row[l] = 0.0;
      for (int j = 0; j < n; j++) {
        const double a = J[i * n + j];
        if (a == 0.0) continue;
        for (int l = 0; l < n; l++) row[l] += a * C[j * n + l];
      }
    }
    for (int i = 0; i < nx; i++) {
      for (int l = i; l < nx; l++) {
        double total = 0.0;
        for (int j = 0; j < n; j++) total += Y[i * n + j] * J[l * n + j];
        C[(nw + i) * n + nw + l] = C[(nw + l) * n + nw + i] = total;
      }
      for (int l = 0; l < n; l++)
        if (l < nw || l >= nw + nx) C[(nw + i) * n + l] = C[l * n + nw + i] = Y[i * n + l];
    }
  }
  for (int i = 0; i < width; i++)
    for (int l = 0; l < width; l++) covariance[i * width + l] = C[(nw + i) * n + nw + l];
}

/* Eigenvectors of A in the columns of V, eigenvalues on A's diagonal (Jacobi's method). */
static void eigenvectors(double *A, double *V, int n) {
  for (int i = 0; i < n; i++)
    for (int l = 0; l < n; l++) V[i * n + l] = i == l;
  for (int sweep = 0, rotated = 1; sweep < MAX_SWEEPS && rotated; sweep++) {
    rotated = 0;
    for (int p = 0; p < n; p++)
      for (int q = p + 1; q < n; q++) {
        const double off = A[p * n + q];
        if (!(fabs(off) > 1e-17 * sqrt(fabs(A[p * n + p] * A[q * n + q])))) continue;
        rotated = 1;
        const double theta = (A[q * n + q] - A[p * n + p]) / (2.0 * off);
        const double t = (theta < 0.0 ? -1.0 : 1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
        const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
        for (int i = 0; i < n; i++) {
          const double a = A[i * n + p], b = A[i * n + q];
          A[i * n + p] = c * a - s * b, A[i * n + q] = s * a + c * b;
        }
        for (int i = 0; i < n; i++) {
          const double a = A[p * n + i], b = A[q * n + i];
          A[p * n + i] = c * a - s * b, A[q * n + i] = s * a + c * b;
        }
        for (int i = 0; i < n; i++) {
          const double a = V[i * n + p], b = V[i * n + q];
          V[i * n + p] = c * a - s * b, V[i * n + q] = s * a + c * b;
        }
      }
  }
}

static int unknown(double *covariance, int width) {
  for (int i = 0; i < width; i++)
    for (int l = 0; l < width; l++) covariance[i * width + l] = i == l ? HUGE_VAL : NAN;
  return 0;
}

/* Mark in a covariance of (x_N, p) what the window does not determine; returns the number of directions that it does. */
static int mark_undetermined(core *k, const model *m, const double *h, double *covariance) {
  const int width = NX(k->s) + k->np, nw = NW(k->s);
  double *large = k->S + 3 * k->n * k->n, *small = large + width * width, *V = small + width * width;
  if (factorize(k, m, h, LARGE_DAMPING) == NOT_A_NUMBER) return unknown(covariance, width);
  propagate(k, m, large);
  if (factorize(k, m, h, SMALL_DAMPING) == NOT_A_NUMBER) return unknown(covariance, width);
  propagate(k, m, small);
  for (int i = 0; i < width; i++)
    for (int l = 0; l < width; l++) {
      const double unit = sqrt(h[nw + i] * h[nw + l]); /* every signal with a curvature of about one */
      small[i * width + l] *= unit;
      large[i * width + l] *= unit;
    }
  eigenvectors(small, V, width);
  int rank = width;
  for (int e = 0; e < width; e++) {
    double with_large = 0.0;
    for (int i = 0; i < width; i++)
      for (int l = 0; l < width; l++) with_large += V[i * width + e] * large[i * width + l] * V[l * width + e];
    if (small[e * width + e] <= 3.0 * fabs(with_large)) continue;
    rank--;
    for (int i = 0; i < width; i++)
      if (fabs(V[i * width + e]) > INVOLVED) covariance[i * width + i] = HUGE_VAL;
  }
  for (int i = 0; i < width; i++)
    for (int l = 0; l < width; l++)
      if (i != l && (covariance[i * width + i] == HUGE_VAL || covariance[l * width + l] == HUGE_VAL))
        covariance[i * width + l] = NAN;
  return rank;
}

/* The same from the factors in memory: the model's without bounds, damping and second derivatives; `status` is
 * factorize's. */
static void covariance_from_factors(core *k, const model *m, int status, double *covariance, int *rank) {
  const int nw = NW(k->s), width = NX(k->s) + k->np;
  double *h = k->v;
  curvatures(k, m, h);
  *rank = width;
  if (status != NOT_A_NUMBER) propagate(k, m, covariance);
  for (int i = 0; i < width && status == OK; i++)
    if (!(covariance[i * (width + 1)] * h[nw + i] <= DETERMINED)) status = INCONSISTENT;
  if (status == INCONSISTENT) *rank = mark_undetermined(k, m, h, covariance);
  if (status == NOT_A_NUMBER) *rank = unknown(covariance, width);
  for (int i = 0; i < width; i++)
    for (int l = 0; l < width; l++) covariance[i * width + l] *= k->scale[nw + i] * k->scale[nw + l];
}

int ctmhe_covariance(const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_result *point,
                     double *covariance, int *rank, void *scratch) {
  core memory, *k = &memory;
  model *m = &k->a;
  const int N = window->n;
  k->s = stage;
  k->win = window;
  k->N = N;
  k->np = window->p_estimated ? NP(stage) : 0;
  k->n = NW(stage) + NX(stage) + k->np;
  k->nb = 0;
  lay_out(k, scratch, stage, N, k->np, k->nb);
  k->memo->valid = 0;
  k->stale = NULL;
  prepare(k, point);
  copy(m->x, point->x, (size_t)((N + 1) * NX(stage)));
  copy(m->w, point->w, (size_t)(N * NW(stage)));
  copy(m->p, point->p, (size_t)NP(stage));
  if (linearize(k, m)) {
    *rank = unknown(covariance, NX(stage) + k->np);
    return CTMHE_NOT_FINITE;
  }
  for (int i = 0; i < k->n; i++) k->v[i] = 0.0;
  covariance_from_factors(k, m, factorize(k, m, k->v, 0.0), covariance, rank);
  return CTMHE_CONVERGED;
}

#endif
