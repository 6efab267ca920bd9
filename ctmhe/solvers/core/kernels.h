/* The kernels of wide.h for vectors of BYTES bytes, which NAME(x) and FOR mark; no guard: it is included once for each.
 */
#define LANES (BYTES / 8)

typedef double NAME(vector) __attribute__((vector_size(BYTES), aligned(8), may_alias));
#define AT(address) (*(NAME(vector) *)(address))
#define FROM(address) (*(const NAME(vector) *)(address))

/* target = base + sign * the sum of left' right over the listed rows (NULL: all from..to-1), for four columns of `left`
 * and one or two vectors of columns of `right` (base NULL: zero); with d, divided by the triangle u with pivots 1 / d.
 *
 * The eight sums stay in registers. They are spelt out because a compiler keeps arrays of vectors in memory. */
FOR INLINE void NAME(tile)(double *target, const double *base, const int sign, int n, const double *left,
                           const double *right, const int *list, int from, int to, const int vectors, const double *u,
                           const double *d) {
  NAME(vector) a0, a1, b0, b1, c0, c1, d0, d1;
  a0 = a1 = b0 = b1 = c0 = c1 = d0 = d1 = (NAME(vector)){0.0};
  for (int k = from; k < to; k++) {
    const size_t row = (size_t)(list ? list[k] : k) * (size_t)n;
    const double *l = left + row, *r = right + row;
    const NAME(vector) p = FROM(r);
    a0 += l[0] * p, b0 += l[1] * p, c0 += l[2] * p, d0 += l[3] * p;
    if (vectors == 2) {
      const NAME(vector) q = FROM(r + LANES);
      a1 += l[0] * q, b1 += l[1] * q, c1 += l[2] * q, d1 += l[3] * q;
    }
  }
#define ADDED(sum, at) sum = sign > 0 ? FROM(at) + sum : FROM(at) - sum
#define FINISH(a, b, c, e, shift)                                      \
  do {                                                                 \
    if (base) {                                                        \
      ADDED(a, base + shift);                                          \
      ADDED(b, base + shift + n);                                      \
      ADDED(c, base + shift + 2 * n);                                  \
      ADDED(e, base + shift + 3 * n);                                  \
    }                                                                  \
    if (d) {                                                           \
      a *= d[0];                                                       \
      b = (b - u[1] * a) * d[1];                                       \
      c = (c - u[2] * a - u[6] * b) * d[2];                            \
      e = (e - u[3] * a - u[7] * b - u[11] * c) * d[3];                \
    }                                                                  \
    AT(target + shift) = a, AT(target + shift + n) = b;                \
    AT(target + shift + 2 * n) = c, AT(target + shift + 3 * n) = e;    \
  } while (0)
  FINISH(a0, b0, c0, d0, 0);
  if (vectors == 2) FINISH(a1, b1, c1, d1, LANES);
#undef FINISH
#undef ADDED
}

/* The same for any number of columns: tiles, and what they leave one by one. */
FOR INLINE void NAME(panel)(double *target, const double *base, const int sign, int n, const double *left,
                            const double *right, const int *list, int from, int to, int columns, const double *u,
                            const double *d) {
  int l = 0;
  for (; l + 2 * LANES <= columns; l += 2 * LANES)
    NAME(tile)(target + l, base ? base + l : NULL, sign, n, left, right + l, list, from, to, 2, u, d);
  if (l + LANES <= columns) {
    NAME(tile)(target + l, base ? base + l : NULL, sign, n, left, right + l, list, from, to, 1, u, d);
    l += LANES;
  }
  if (l < columns)
    edge(target + l, base ? base + l : NULL, sign, n, left, right + l, list, from, to, 4, columns - l, u, d);
}

/* Cholesky rows for the first `count` variables and the Schur complement of the others, upper triangles; `strict`: a
 * negative pivot ends it. */
FOR static int NAME(wide_eliminate)(double *M, double *D, const double *floor, const uint8_t *skip, int count, int n,
                                    int strict) {
  int status = OK, rows;
  for (int j = 0; j < n; j += rows) {
    const int end = j < count ? count : n, depth = j < count ? j : count;
    double *block = M + j * n + j, u[16] = {0.0}, d[4] = {0.0};
    rows = end - j < 4 ? end - j : 4;
    const int behind = n - j - rows;
    if (rows == 4) NAME(panel)(block, block, -1, n, M + j, M + j, NULL, 0, depth, 4, NULL, NULL);
    else edge(block, block, -1, n, M + j, M + j, NULL, 0, depth, rows, rows, NULL, NULL);
    if (j < count) {
      const int outcome = factor_block(block, n, D + j, floor + j, skip + j, rows, strict, u, d);
      if (outcome) {
        if (strict || outcome == NOT_A_NUMBER) return outcome;
        status = outcome;
      }
    }
    for (int r = 0; r < rows; r++) /* tiles, wherever they begin, read three elements left of the diagonal */
      for (int l = j + r < 3 ? 0 : j + r - 3; l < j + r; l++) M[(j + r) * n + l] = 0.0;
    double *rest = block + rows;
    const double *left = M + j, *right = left + rows;
    if (rows < 4) edge(rest, rest, -1, n, left, right, NULL, 0, depth, rows, behind, u, j < count ? d : NULL);
    else if (j < count) NAME(panel)(rest, rest, -1, n, left, right, NULL, 0, depth, behind, u, d);
    else NAME(panel)(rest, rest, -1, n, left, right, NULL, 0, depth, behind, NULL, NULL);
  }
  return status;
}

/* M = H + T' P T, T = [B A E; 0 0 I] (with the identity of w when o = 0), without the zeros of [B A E]. With
 * `factored`, P = U'U and U is given; else P is full in rows and columns o..n-1. */
FOR static void NAME(wide_add)(double *M, const double *H, const double *P, const double *J, double *work,
                               int factored, int o, int nx, int nw, int np) {
  const int n = nw + nx + np;
  double *Y = work, *square = Y + n * n;
  int *list = (int *)(square + n * n), *entries = list + nx * n;
  list_rows(list, entries, J, nx, n);
  if (factored) {
    int i = o;
    for (; i + 4 <= n; i += 4)
      NAME(panel)(square + i * n + i, NULL, 1, n, P + i, P + i, NULL, o, i + 4, n - i, NULL, NULL);
    if (i < n) edge(square + i * n + i, NULL, 1, n, P + i, P + i, NULL, o, n, n - i, n - i, NULL, NULL);
    mirror(square, o, n);
    P = square;
  }
  for (int l = 0, block = 0; l < n; l += 4, block++) { /* Y = P T */
    const int *rows = list + block * nx, count = entries[block], columns = n - l < 4 ? n - l : 4;
    int i = o;
    for (; i + 4 <= n; i += 4)
      NAME(panel)(Y + i * n + l, NULL, 1, n, P + nw * n + i, J + l, rows, 0, count, columns, NULL, NULL);
    if (i < n) edge(Y + i * n + l, NULL, 1, n, P + nw * n + i, J + l, rows, 0, count, n - i, columns, NULL, NULL);
  }
  for (int i = o; i < n; i++) {
    for (int l = o; l < nw; l++) Y[i * n + l] += P[i * n + l];
    for (int l = nw + nx; l < n; l++) Y[i * n + l] += P[i * n + l];
  }
  for (int l = 0, block = 0; l < n; l += 4, block++) { /* M = H + T'Y */
    const int *rows = list + block * nx, count = entries[block], at = l * n + l;
    const double *left = J + l, *right = Y + nw * n + l;
    if (n - l >= 4) NAME(panel)(M + at, H + at, 1, n, left, right, rows, 0, count, n - l, NULL, NULL);
    else edge(M + at, H + at, 1, n, left, right, rows, 0, count, n - l, n - l, NULL, NULL);
  }
  for (int i = o; i < n; i++)
    if (i < nw || i >= nw + nx)
      for (int l = i; l < n; l++) M[i * n + l] += Y[i * n + l];
}

#undef LANES
#undef AT
#undef FROM
