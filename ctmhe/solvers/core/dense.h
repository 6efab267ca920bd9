/* Dense kernels on the matrices of one slot. */
#ifndef CTMHE_DENSE_H
#define CTMHE_DENSE_H

#include "wide.h"

/* M += S'S over the upper triangle, columns from..n of the first `count` rows of S. */
INLINE void add_square(double *restrict M, const double *restrict S, int count, int from, int n) {
  int j = 0;
  for (; j + TILE <= count; j += TILE) {
    const double *restrict s0 = S + j * n, *restrict s1 = s0 + n, *restrict s2 = s1 + n, *restrict s3 = s2 + n;
    for (int i = from; i < n; i++) {
      const double a0 = s0[i], a1 = s1[i], a2 = s2[i], a3 = s3[i];
      double *restrict row = M + i * n;
      for (int l = i; l < n; l++) row[l] += a0 * s0[l] + a1 * s1[l] + a2 * s2[l] + a3 * s3[l];
    }
  }
  for (; j < count; j++) {
    const double *restrict s0 = S + j * n;
    for (int i = from; i < n; i++) {
      const double a0 = s0[i];
      double *restrict row = M + i * n;
      for (int l = i; l < n; l++) row[l] += a0 * s0[l];
    }
  }
}

/* S rows o..n-1 = U [B A E; 0 0 I] (with the identity of w when o = 0: w is carried). */
INLINE void transform(double *restrict S, const double *restrict U, const double *restrict J, int o, int nx, int nw,
                      int np) {
  const int n = nw + nx + np;
  for (int j = o; j < nw + nx; j++) {
    double *restrict row = S + j * n;
    for (int l = 0; l < n; l++) row[l] = 0.0;
    const int first = j < nw ? 0 : j - nw;
    int i = first;
    for (; i + TILE <= nx; i += TILE) {
      const double *restrict b = J + i * n;
      const double a0 = U[j * n + nw + i], a1 = U[j * n + nw + i + 1], a2 = U[j * n + nw + i + 2],
                   a3 = U[j * n + nw + i + 3];
      for (int l = 0; l < n; l++) row[l] += a0 * b[l] + a1 * b[n + l] + a2 * b[2 * n + l] + a3 * b[3 * n + l];
    }
    for (; i < nx; i++) {
      const double a = U[j * n + nw + i];
      const double *restrict b = J + i * n;
      for (int l = 0; l < n; l++) row[l] += a * b[l];
    }
    for (int l = nw + nx; l < n; l++) row[l] += U[j * n + l];
    for (int l = j; l < nw; l++) row[l] += U[j * n + l];
  }
}

/* M = U'U in place, with reciprocal pivots D; `floor` holds the pivots that count as zero; `skip` rows are zero. */
INLINE int cholesky(double *restrict M, double *restrict D, const double *restrict floor, const uint8_t *skip, int n) {
  if (WIDE(n)) return wide_eliminate(M, D, floor, skip, n, n, 0);
  int status = OK;
  for (int block = 0; block < n; block += TILE) {
    const int end = block + TILE < n ? block + TILE : n;
    for (int j = block; j < end; j++) {
      double *restrict row = M + j * n;
      for (int i = block; i < j; i++) {
        const double *restrict above = M + i * n;
        const double a = above[j];
        for (int l = j; l < n; l++) row[l] -= a * above[l];
      }
      const double pivot = row[j];
      if (!(pivot > floor[j]) || skip[j]) {
        if (pivot != pivot) return NOT_A_NUMBER;
        if (pivot < -1e3 * floor[j] && !skip[j]) status = INDEFINITE;
        D[j] = 0.0;
        for (int l = j; l < n; l++) row[l] = 0.0;
      } else {
        const double root = sqrt(pivot), inverse = 1.0 / root;
        D[j] = inverse;
        row[j] = root;
        for (int l = j + 1; l < n; l++) row[l] *= inverse;
      }
    }
    if (end < n && end - block == TILE) {
      const double *restrict s0 = M + block * n, *restrict s1 = s0 + n, *restrict s2 = s1 + n, *restrict s3 = s2 + n;
      for (int i = end; i < n; i++) {
        const double a0 = s0[i], a1 = s1[i], a2 = s2[i], a3 = s3[i];
        double *restrict row = M + i * n;
        for (int l = i; l < n; l++) row[l] -= a0 * s0[l] + a1 * s1[l] + a2 * s2[l] + a3 * s3[l];
      }
    }
  }
  return status;
}

/* M = H + T' P T over the upper triangle, T = [B A E; 0 0 I] (with the identity of w when it is carried), P full in the
 * rows and columns of what is behind; Y is work of nx rows. */
INLINE void add_plain(double *restrict M, const double *restrict H, const double *restrict P, const double *restrict J,
                      double *restrict Y, int carried, int nx, int nw, int np) {
  const int n = nw + nx + np;
  for (int r = 0; r < nx; r++) { /* rows of x in P T */
    const double *restrict p = P + (nw + r) * n;
    for (int l = 0; l < n; l++) {
      double sum = (l < nw && carried) || l >= nw + nx ? p[l] : 0.0;
      for (int i = 0; i < nx; i++) sum += p[nw + i] * J[i * n + l];
      Y[r * n + l] = sum;
    }
  }
  for (int i = 0; i < n; i++)
    for (int l = i; l < n; l++) {
      double sum = H[i * n + l];
      for (int r = 0; r < nx; r++) sum += J[r * n + i] * Y[r * n + l];
      M[i * n + l] = sum;
    }
  for (int i = 0; i < n; i++) {
    if (i < nw ? !carried : i < nw + nx) continue;
    const double *restrict p = P + i * n;
    for (int l = i; l < n; l++) {
      double sum = l < nw || l >= nw + nx ? p[l] : 0.0;
      for (int r = 0; r < nx; r++) sum += p[nw + r] * J[r * n + l];
      M[i * n + l] += sum;
    }
  }
}

/* Rows for the first `count` variables, D their reciprocal pivots; what remains is their Schur complement, both
 * triangles. A pivot that is zero against its diagonal gives a zero row. */
INLINE int eliminate_plain(double *restrict M, double *restrict D, int count, int n) {
  int status = OK;
  for (int j = 0; j < count; j++) D[j] = PIVOT * M[j * n + j];
  for (int j = 0; j < count; j++) {
    double *restrict row = M + j * n;
    const double pivot = row[j], least = fabs(D[j]);
    if (pivot > least) {
      D[j] = 1.0 / pivot;
    } else {
      if (pivot != pivot) return NOT_A_NUMBER;
      if (pivot < -least) status = INDEFINITE;
      D[j] = 0.0;
      for (int l = j; l < n; l++) row[l] = 0.0;
    }
    for (int i = j + 1; i < n; i++) {
      const double factor = row[i] * D[j];
      for (int l = i; l < n; l++) M[i * n + l] -= factor * row[l];
    }
  }
  for (int i = count; i < n; i++)
    for (int l = i + 1; l < n; l++) M[l * n + i] = M[i * n + l];
  return status;
}

/* The same for wide slots, where the rows are scaled like those of a root. */
INLINE int wide_plain(double *restrict M, double *restrict D, const double *restrict floor,
                      const uint8_t *restrict skip, int count, int n) {
  const int status = wide_eliminate(M, D, floor, skip, count, n, 1);
  for (int i = count; i < n; i++)
    for (int l = i + 1; l < n; l++) M[l * n + i] = M[i * n + l];
  return status;
}

#endif
