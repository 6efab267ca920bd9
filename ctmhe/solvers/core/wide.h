/* The dense kernels for many states: register tiles of vectors, and products that skip the zeros of the Jacobian.
 *
 * A vector runs along a row, never along a sum: every element is summed in the same order whatever the length of the
 * vectors, so the choice made for the processor at run time does not show in the results.
 */
#ifndef CTMHE_WIDE_H
#define CTMHE_WIDE_H

#include "layout.h"

/* Start + the sum of a_i b_i, from..to-1, in the order of i; for slots of n >= WIDE_FROM variables in four sums, which
 * do not wait for each other. */
INLINE double dot(double start, const double *a, const double *b, int from, int to, int n) {
  double more = 0.0, third = 0.0, fourth = 0.0;
  int i = from;
  for (; n >= WIDE_FROM && i + 4 <= to; i += 4) {
    start += a[i] * b[i];
    more += a[i + 1] * b[i + 1];
    third += a[i + 2] * b[i + 2];
    fourth += a[i + 3] * b[i + 3];
  }
  for (; i < to; i++) start += a[i] * b[i];
  return n < WIDE_FROM ? start : start + more + (third + fourth);
}

#if defined(CTMHE_NX) && CTMHE_NX + CTMHE_NW + CTMHE_NP < WIDE_FROM
#define CTMHE_NARROW
#endif
#if defined(__GNUC__) && !defined(CTMHE_NARROW) /* which stands for a compiler without vectors */
#define WIDE(n) ((n) >= WIDE_FROM)

/* Like a tile (kernels.h), for up to four rows and any number of columns. */
INLINE void edge(double *target, const double *base, int sign, int n, const double *left, const double *right,
                 const int *list, int from, int to, int rows, int columns, const double *u, const double *d) {
  for (int l = 0; l < columns; l++) {
    double sum[4] = {0.0};
    for (int k = from; k < to; k++) {
      const size_t row = (size_t)(list ? list[k] : k) * (size_t)n;
      for (int r = 0; r < rows; r++) sum[r] += left[row + (size_t)r] * right[row + (size_t)l];
    }
    for (int r = 0; r < rows; r++) {
      const int at = r * n + l;
      if (base) sum[r] = sign > 0 ? base[at] + sum[r] : base[at] - sum[r];
      if (d) {
        for (int i = 0; i < r; i++) sum[r] -= u[4 * i + r] * sum[i];
        sum[r] *= d[r];
      }
      target[at] = sum[r];
    }
  }
}

/* Cholesky of a block of up to four rows, also into u and d. */
INLINE int factor_block(double *block, int n, double *D, const double *floor, const uint8_t *skip, int rows,
                        int strict, double *u, double *d) {
  int status = OK;
  for (int r = 0; r < rows; r++) {
    for (int l = r; l < rows; l++) {
      double rest = block[r * n + l];
      for (int i = 0; i < r; i++) rest -= u[4 * i + r] * u[4 * i + l];
      u[4 * r + l] = rest;
    }
    const double pivot = u[5 * r], least = fabs(floor[r]);
    if (pivot != pivot) return NOT_A_NUMBER;
    if (pivot > least && !skip[r]) {
      u[5 * r] = sqrt(pivot);
      d[r] = 1.0 / u[5 * r];
      for (int l = r + 1; l < rows; l++) u[4 * r + l] *= d[r];
    } else { /* no step that way */
      if (!skip[r] && pivot < -(strict ? 1.0 : 1e3) * least) {
        if (strict) return INDEFINITE;
        status = INDEFINITE;
      }
      for (int l = r; l < rows; l++) u[4 * r + l] = 0.0;
    }
    D[r] = d[r];
    for (int l = r; l < rows; l++) block[r * n + l] = u[4 * r + l];
  }
  return status;
}

INLINE void mirror(double *M, int from, int n) {
  int i = from;
  for (; i + 4 <= n; i += 4) {
    const double *source = M + i * n;
    for (int l = i + 1; l < n; l++)
      for (int r = 0; r < 4 && r + i < l; r++) M[l * n + i + r] = source[r * n + l];
  }
  for (; i < n; i++)
    for (int l = i + 1; l < n; l++) M[l * n + i] = M[i * n + l];
}

/* The rows of J that are not zero in columns 4 b .. 4 b + 3, as lists nx apart. */
INLINE void list_rows(int *list, int *entries, const double *J, int nx, int n) {
  const int whole = n / 4;
  for (int b = 0; b < whole; b++) {
    int count = 0;
    for (int i = 0; i < nx; i++) {
      uint64_t word[4];
      memcpy(word, J + i * n + 4 * b, sizeof word);
      list[b * nx + count] = i;
      count += (word[0] | word[1] | word[2] | word[3]) << 1 != 0; /* a shift drops the sign of a zero */
    }
    entries[b] = count;
  }
  if (4 * whole < n) {
    for (int i = 0; i < nx; i++) list[whole * nx + i] = i;
    entries[whole] = nx;
  }
}

#ifndef __AVX2__
#define BYTES 16
#define FOR
#define NAME(x) x##_16
#include "kernels.h"
#undef BYTES
#undef FOR
#undef NAME
#endif

#if defined(__AVX2__) || defined(__x86_64__) && !defined(__clang__) && !defined(CTMHE_BASELINE)
#define BYTES 32
#define FOR __attribute__((target("avx2")))
#define NAME(x) x##_32
#include "kernels.h"
#undef BYTES
#undef FOR
#undef NAME
#ifdef __AVX2__
#define CHOOSE(kernel) kernel##_32
#else
#define CHOOSE(kernel) (__builtin_cpu_supports("avx2") ? kernel##_32 : kernel##_16)
#endif
#else
#define CHOOSE(kernel) kernel##_16
#endif

#define wide_eliminate CHOOSE(wide_eliminate)
#define wide_add CHOOSE(wide_add)

#else
#define WIDE(n) 0
INLINE int wide_eliminate(double *M, double *D, const double *floor, const uint8_t *skip, int count, int n, int strict) {
  (void)M, (void)D, (void)floor, (void)skip, (void)count, (void)n, (void)strict;
  return OK;
}
#define wide_add(...) ((void)0)
#endif

#endif
