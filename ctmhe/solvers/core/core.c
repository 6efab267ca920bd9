/* The structured Gauss-Newton core; see core.h for the interface and gauss_newton.py for the same method in Python.
 *
 * Variables of a slot are ordered v = (w, x, p), in scaled units, and matrices over them are row-major with n columns.
 * The value function of the window behind edge k is |U v|^2 / 2 + q'v, U upper triangular. One slot back,
 *
 *     M = H + S'S,  S = U [B A E; 0 0 I],      m = g + [B A E; 0 0 I]' (q + U'U c)
 *
 * and the Cholesky factor of M eliminates w in its leading rows and is the next U in its trailing ones. A slot that
 * shares w with the slot before it does not eliminate: w travels with the state. The parameters travel to the window's
 * start and are eliminated there, with x_0. A pivot that is zero to rounding gives a zero row: no step that way.
 *
 * Bounds held on w, p and x_0 are substituted. Bounds held on later states and on outputs are stiff springs with
 * multipliers (an augmented Lagrangian); right-hand-side solves with the same factor bring them onto the bound. When
 * the active set does not settle, a primal-dual interior point method (all bounds as springs) finds it.
 */
#include "core.h"

#include <math.h>
#include <string.h>

#ifdef CTMHE_NX
#define NX(s) ((void)(s), CTMHE_NX)
#define NW(s) ((void)(s), CTMHE_NW)
#define NP(s) ((void)(s), CTMHE_NP)
#define NY(s) ((void)(s), CTMHE_NY)
#define NQ(s) ((void)(s), CTMHE_NQ)
#else
#define NX(s) ((s)->nx)
#define NW(s) ((s)->nw)
#define NP(s) ((s)->np)
#define NY(s) ((s)->ny)
#define NQ(s) ((s)->q)
#endif

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#define ARMIJO 1e-4
#define DAMPING_START 1e-8
#define DAMPING_LIMIT 1e8
#define ROUND_OFF 1e-15
#define SETTLED 25 /* iterations after which the penalty only grows */
#define MEMORY 4   /* iterates that the merit function may fall back on */
#define SLOW 0.05          /* predicted decreases that shrink by less than this factor call for second derivatives */
#define MAX_CHANGES 30     /* passes of the active set method in one quadratic program */
#define MAX_SINGLE 10      /* of which with a single change each */
#define MAX_BARRIER 80     /* iterations of the interior point method that takes over */
#define INTERIOR 1e-11     /* its complementarity, relative */
#define PIVOT 1e-13        /* a pivot this small against its diagonal is zero */
#define STIFFNESS 1e6      /* springs against typical curvature of the states */
#define MAX_CORRECTIONS 12
#define HELD 1e-11         /* accuracy of a held bound, scaled */
#define TILE 4

enum { OK = 0, INDEFINITE = 1, NOT_A_NUMBER = 2, INCONSISTENT = 3 };
enum { ZERO = 0, DIAGONAL = 1, DENSE = 2 };

typedef struct {           /* the problem linearised at a point */
  double *x, *w, *p, *y;
  double *c;               /* (N, nx) scaled defects */
  double *H, *g;           /* (N, n, n) upper triangles, (N, n) */
  double *J;               /* (N, nx + nb, n) scaled dynamics rows, then bounded output rows */
  double cost, infeasibility, defect, excess;
} model;

typedef struct {
  const ctmhe_stage *s;
  const ctmhe_window *win;
  int N, n, np, nb;        /* n = nw + nx + np; np: estimated parameters; nb: bounded outputs */
  int bounded;             /* any finite bound at all */
  size_t nf;               /* flat vectors: x (N+1, nx), w (N, nw), y (N, nb), p (np) */
  size_t fw, fy, fp;       /* where w, y, p start in them */
  double *scale, *inverse_x; /* (n) of v; 1 / x_scale */
  double *W, *P;           /* scaled weights of w (N, nw, nw) and of the prior (m, m) */
  uint8_t *kind_w, *kind_y;
  double *rows;            /* (q ny, n) weighted output rows of one slot */
  double *residual;        /* (q ny) */
  double *S, *t, *v, *r;   /* work of one slot */
  double *U, *D, *q;       /* factors (N+1, n, n), reciprocal pivots (N+1, n), gradients (N+1, n) */
  double *lower, *upper;   /* flat, raw bounds without copies */
  double *low, *high;      /* flat, relative to the point, scaled */
  double *inverse;         /* (nx + nw + nb + np) reciprocal scales in flat order */
  double *d, *z, *spring, *force; /* flat: step, multipliers, springs, gradients of springs */
  double *z_low, *z_high, *s_low, *s_high, *start; /* flat: interior point multipliers, slacks, last step */
  double *barrier_spring, *barrier_force;          /* flat */
  int barrier;             /* the interior point method is at work */
  double *lambda;          /* (N, nx) */
  int8_t *active, *candidate, *cautious, *kept;
  uint8_t *fixed;
  double *scratch_y;       /* nx + q ny + Jacobian of one slot for compiled functions, and n0 x n0 */
  model a, b;
  int plain;               /* with second derivatives: keep P = U'U itself, which may be indefinite */
  double stiffness, damping;
  double decrease, optimality, stationarity; /* of the last step */
} core;

typedef struct {
  char *at;
  size_t used;
} arena;

static void *take(arena *m, size_t bytes) {
  void *at = m->at ? m->at + m->used : NULL;
  m->used += (bytes + 63) & ~(size_t)63;
  return at;
}

#define DOUBLES(m, count) ((double *)take((m), sizeof(double) * (size_t)(count)))

static void lay_out_model(model *m, arena *memory, size_t N, size_t nx, size_t nw, size_t np, size_t qy, size_t n,
                          size_t nb) {
  m->x = DOUBLES(memory, (N + 1) * nx);
  m->w = DOUBLES(memory, N * nw);
  m->p = DOUBLES(memory, np);
  m->y = DOUBLES(memory, N * qy);
  m->c = DOUBLES(memory, N * nx);
  m->H = DOUBLES(memory, N * n * n);
  m->g = DOUBLES(memory, N * n);
  m->J = DOUBLES(memory, N * (nx + nb) * n);
}

static size_t lay_out(core *k, char *scratch, const ctmhe_stage *s, int slots, int np, int nb) {
  const size_t N = (size_t)slots, nx = (size_t)NX(s), nw = (size_t)NW(s), ny = (size_t)NY(s), q = (size_t)NQ(s);
  const size_t all = (size_t)NP(s), n = nw + nx + (size_t)np, qy = q * ny, n0 = nx + nw + all;
  arena memory = {scratch, 0};
  k->fw = (N + 1) * nx;
  k->fy = k->fw + N * nw;
  k->fp = k->fy + N * (size_t)nb;
  k->nf = k->fp + (size_t)np;
  k->scale = DOUBLES(&memory, n);
  k->inverse_x = DOUBLES(&memory, nx);
  k->inverse = DOUBLES(&memory, nx + nw + (size_t)nb + (size_t)np);
  k->W = DOUBLES(&memory, N * nw * nw);
  k->P = DOUBLES(&memory, (nx + (size_t)np) * (nx + (size_t)np));
  k->rows = DOUBLES(&memory, qy * n + 1);
  k->residual = DOUBLES(&memory, qy + 1);
  k->S = DOUBLES(&memory, (n + TILE) * n);
  k->t = DOUBLES(&memory, n0 + n);
  k->v = DOUBLES(&memory, n0 + n);
  k->r = DOUBLES(&memory, n0 + n);
  k->U = DOUBLES(&memory, (N + 1) * n * n);
  k->D = DOUBLES(&memory, (N + 1) * n);
  k->q = DOUBLES(&memory, (N + 1) * n);
  k->lower = DOUBLES(&memory, k->nf);
  k->upper = DOUBLES(&memory, k->nf);
  k->low = DOUBLES(&memory, k->nf);
  k->high = DOUBLES(&memory, k->nf);
  k->d = DOUBLES(&memory, k->nf);
  k->z = DOUBLES(&memory, k->nf);
  k->spring = DOUBLES(&memory, k->nf);
  k->force = DOUBLES(&memory, k->nf);
  k->z_low = DOUBLES(&memory, k->nf);
  k->z_high = DOUBLES(&memory, k->nf);
  k->s_low = DOUBLES(&memory, k->nf);
  k->s_high = DOUBLES(&memory, k->nf);
  k->start = DOUBLES(&memory, k->nf);
  k->barrier_spring = DOUBLES(&memory, k->nf);
  k->barrier_force = DOUBLES(&memory, 3 * k->nf); /* and the centring terms */
  k->lambda = DOUBLES(&memory, N * nx);
  k->scratch_y = DOUBLES(&memory, nx + qy + (nx + qy) * n0 + n0 * n0);
  lay_out_model(&k->a, &memory, N, nx, nw, all, qy, n, (size_t)nb);
  lay_out_model(&k->b, &memory, N, nx, nw, all, qy, n, (size_t)nb);
  k->kind_w = take(&memory, N);
  k->kind_y = take(&memory, N * q + 1);
  k->fixed = take(&memory, k->nf);
  k->active = take(&memory, k->nf);
  k->candidate = take(&memory, k->nf);
  k->cautious = take(&memory, k->nf);
  k->kept = take(&memory, k->nf);
  return memory.used;
}

size_t ctmhe_scratch_size(const ctmhe_stage *stage, int n) {
  core k;
  return lay_out(&k, NULL, stage, n, NP(stage), NY(stage));
}

void ctmhe_sizes(int *nx, int *nw, int *np, int *ny, int *q, int *version) {
#ifdef CTMHE_NX
  *nx = CTMHE_NX, *nw = CTMHE_NW, *np = CTMHE_NP, *ny = CTMHE_NY, *q = CTMHE_NQ;
#else
  *nx = *nw = *np = *ny = *q = 0;
#endif
  *version = CTMHE_CORE_VERSION;
}

static void copy(double *to, const double *from, size_t count) {
  if (count) memcpy(to, from, sizeof(double) * count);
}

/* ---- The model ---------------------------------------------------------------------------------------------- */

/* Evaluate a stage function at slot k of a point; results come back as pointers. Returns nonzero on failure. */
static int evaluate(const core *k, const ctmhe_function *f, const model *m, int slot, int results, double **out,
                    const double *lambda_x, const double *lambda_y) {
  const ctmhe_stage *s = k->s;
  const ctmhe_window *win = k->win;
  const size_t i = (size_t)slot, nx = (size_t)NX(s), nw = (size_t)NW(s), nu = (size_t)s->nu;
  const size_t qy = (size_t)(NQ(s) * NY(s)), n0 = nx + nw + (size_t)NP(s);
  const double *arg[9] = {win->t + i,  win->h + i,       m->x + i * nx,    m->w + i * nw, m->p,
                          win->u0 + i * nu, win->u1 + i * nu, lambda_x, lambda_y};
  if (f->function) {
    const double *given[CTMHE_MAX_ARGUMENTS];
    double *taken[CTMHE_MAX_ARGUMENTS];
    memcpy(given, arg, sizeof arg);
    if (results == 1) {
      out[0] = k->scratch_y + nx + qy + (nx + qy) * n0;
    } else {
      out[0] = k->scratch_y;
      out[1] = out[0] + nx;
      out[2] = out[1] + qy;
    }
    memcpy(taken, out, sizeof(double *) * (size_t)results);
    return f->function(given, taken, f->iw, f->w, 0);
  }
  const size_t length[9] = {1, 1, nx, nw, (size_t)NP(s), nu, nu, nx, qy};
  const int arguments = lambda_x ? 9 : 7;
  for (int j = 0; j < arguments; j++)
    for (size_t l = 0; l < length[j]; l++) f->arg[j][l] = arg[j][l];
  for (int j = 0; j < results; j++) out[j] = f->res[j];
  f->eval(f->self);
  return f->failed && *f->failed;
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
  double cost = 0.0, infeasibility = 0.0, defect = 0.0, excess = 0.0, finite = 0.0;
  double *scaled_w = k->v;
  for (int i = 0; i < width; i++) { /* prior */
    double r = 0.0;
    for (int j = 0; j < width; j++)
      r += win->L_prior[i * width + j] * ((j < nx ? m->x[j] : m->p[j - nx]) - win->prior[j]);
    cost += r * r;
  }
  for (int slot = 0; slot < N; slot++) {
    double *out[3] = {NULL, NULL, NULL};
    if (evaluate(k, f, m, slot, with_jacobian ? 3 : 2, out, NULL, NULL)) return 1;
    const double *next = m->x + (size_t)(slot + 1) * (size_t)nx, *y = out[1];
    double *c = m->c + (size_t)slot * (size_t)nx;
    for (int i = 0; i < nx; i++) {
      c[i] = (out[0][i] - next[i]) * k->inverse_x[i];
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
    if (with_jacobian) {
      memset(H, 0, sizeof(double) * (size_t)(n * n));
      memset(g, 0, sizeof(double) * (size_t)n);
    }
    for (int i = 0; i < nw; i++) scaled_w[i] = w[i] / k->scale[i];
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
      const int used = weighted_rows(k, slot, point, y + point * ny, with_jacobian ? out[2] : NULL, k->rows,
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
    if (!with_jacobian) continue;
    double *restrict J = m->J + (size_t)slot * (size_t)((nx + nb) * n);
    for (int i = 0; i < nx; i++) {
      const double *source = out[2] + i;
      const double back = k->inverse_x[i];
      double *row = J + i * n;
      for (int j = 0; j < nw; j++) row[j] = source[(nx + j) * height] * back;
      for (int j = 0; j < nx; j++) row[nw + j] = source[j * height] * back;
      for (int j = 0; j < np; j++) row[nw + nx + j] = source[(nx + nw + j) * height] * back;
      for (int j = 0; j < n; j++) row[j] *= k->scale[j];
    }
    for (int i = 0; i < nb; i++) {
      const double *source = out[2] + nx + (q - 1) * ny + i;
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
  }
  m->cost = cost + finite;
  m->infeasibility = infeasibility;
  m->defect = defect;
  m->excess = excess;
  return 0;
}

static int linearize(core *k, model *m) {
  if (k->np) return linearize_sized(k, m, 1, NX(k->s), NW(k->s), NP(k->s));
  return linearize_sized(k, m, 1, NX(k->s), NW(k->s), 0);
}

static int assess(core *k, model *m) { return linearize_sized(k, m, 0, NX(k->s), NW(k->s), k->np); }

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
    double *out[3] = {NULL, NULL, NULL};
    if (evaluate(k, &s->curvature, m, slot, 1, out, lambda_x, lambda_y)) return 1;
    double *H = m->H + (size_t)slot * (size_t)(n * n);
    for (int i = 0; i < n; i++) {
      const int from = i < nw ? nx + i : i < nw + nx ? i - nw : i;
      for (int j = i; j < n; j++) {
        const int to = j < nw ? nx + j : j < nw + nx ? j - nw : j;
        H[i * n + j] += out[0][from + to * n0] * k->scale[i] * k->scale[j];
      }
    }
  }
  return 0;
}

/* ---- Factorisation ------------------------------------------------------------------------------------------ */

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

/* M += T' P T, T = [B A E; 0 0 I] (with the identity of w when o = 0), P full in rows and columns o..n-1; Y is work. */
INLINE void add_plain(double *restrict M, const double *restrict P, const double *restrict J, double *restrict Y, int o,
                      int nx, int nw, int np) {
  const int n = nw + nx + np;
  for (int j = o; j < n; j++) {
    double *restrict row = Y + j * n;
    for (int l = 0; l < n; l++) row[l] = (l >= o && l < nw) || l >= nw + nx ? P[j * n + l] : 0.0;
    for (int i = 0; i < nx; i++) {
      const double a = P[j * n + nw + i];
      for (int l = 0; l < n; l++) row[l] += a * J[i * n + l];
    }
  }
  for (int r = 0; r < nx; r++)
    for (int i = 0; i < n; i++) {
      const double a = J[r * n + i];
      for (int l = i; l < n; l++) M[i * n + l] += a * Y[(nw + r) * n + l];
    }
  for (int i = o; i < n; i++)
    if (i < nw || i >= nw + nx)
      for (int l = i; l < n; l++) M[i * n + l] += Y[i * n + l];
}

/* Cholesky rows for the first `count` variables; what remains is their Schur complement, both triangles. */
INLINE int eliminate_plain(double *restrict M, double *restrict D, const double *restrict floor,
                           const uint8_t *restrict skip, int count, int n) {
  for (int j = 0; j < count; j++) {
    double *restrict row = M + j * n;
    const double pivot = row[j];
    if (pivot != pivot) return NOT_A_NUMBER;
    D[j] = 0.0;
    if (skip[j]) continue; /* its row and column are zero */
    if (!(pivot > fabs(floor[j]))) {
      if (pivot < -fabs(floor[j])) return INDEFINITE;
      for (int l = j; l < n; l++) row[l] = 0.0;
      continue;
    }
    D[j] = 1.0 / sqrt(pivot);
    for (int l = j; l < n; l++) row[l] *= D[j];
    for (int i = j + 1; i < n; i++)
      for (int l = i; l < n; l++) M[i * n + l] -= row[i] * row[l];
  }
  for (int i = count; i < n; i++)
    for (int l = i + 1; l < n; l++) M[l * n + i] = M[i * n + l];
  return OK;
}

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
      double t = 0.0;
      for (int i = j < nw ? 0 : j - nw; i < nx; i++) t += U[j * n + nw + i] * c[i];
      for (int i = j; i < n; i++) y[i] += U[j * n + i] * t;
    }
  for (int i = 0; i < nx; i++) {
    const double a = y[nw + i];
    for (int l = 0; l < n; l++) m[l] += a * J[i * n + l];
  }
  for (int i = o; i < nw; i++) m[i] += y[i];
  for (int i = nw + nx; i < n; i++) m[i] += y[i];
}

INLINE void forward_eliminate(double *restrict m, const double *restrict U, const double *restrict D, int count,
                              int n) {
  for (int j = 0; j < count; j++) {
    const double l = m[j] * D[j];
    m[j] = l;
    for (int i = j + 1; i < n; i++) m[i] -= U[j * n + i] * l;
  }
}

/* Backward sweep from slot `from`: factors and gradients, or with `right_hand_side` the gradients of k->force only. */
INLINE int backward_sized(core *k, const model *m, int from, int right_hand_side, int nx, int nw, int np) {
  const int n = nw + nx + np, N = k->N, nb = k->nb;
  const uint8_t *shared = k->win->shared;
  const size_t nn = (size_t)(n * n);
  uint8_t *skip = (uint8_t *)k->r;
  double *floor = k->t;
  int status = OK;
  if (from >= N) {
    double *U = k->U + (size_t)N * nn, *q = k->q + (size_t)N * (size_t)n;
    for (int i = 0; i < n; i++) q[i] = 0.0;
    if (!right_hand_side) memset(U, 0, sizeof(double) * nn);
    for (int i = 0; i < nx; i++) {
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
        U[(nw + i) * n + nw + i] = k->plain ? weight : sqrt(weight);
      }
    }
    from = N - 1;
  }
  for (int slot = from; slot >= 0; slot--) {
    const int carried = shared[slot] && slot + 1 < N, first = slot == 0 || !shared[slot - 1], o = carried ? 0 : nw;
    double *U = k->U + (size_t)slot * nn, *D = k->D + (size_t)(slot * n), *q = k->q + (size_t)(slot * n);
    const double *behind = U + nn, *J = m->J + (size_t)(slot * (nx + nb)) * (size_t)n;
    const int eliminated = slot == 0 ? n : first ? nw : 0;
    if (right_hand_side)
      for (int i = 0; i < n; i++) q[i] = 0.0;
    else {
      const double *g = m->g + (size_t)(slot * n), *H = m->H + (size_t)slot * nn;
      for (int i = 0; i < n; i++) q[i] = g[i];
      for (size_t i = 0; i < nn; i++) U[i] = H[i];
      if (k->plain) {
        add_plain(U, behind, J, k->S, o, nx, nw, np);
      } else {
        transform(k->S, behind, J, o, nx, nw, np);
        add_square(U, k->S + o * n, nw + nx - o, 0, n);
        if (np) add_square(U, behind + (nw + nx) * n, np, nw + nx, n);
      }
    }
    pull_back(q, behind, k->q + (size_t)((slot + 1) * n), J,
              right_hand_side ? NULL : m->c + (size_t)(slot * nx), k->v, k->plain, o, nx, nw, np);
    if (k->bounded) {
      if (slot)
        for (int i = 0; i < nx; i++) {
          const size_t at = (size_t)(slot * nx + i);
          if (!k->active[at]) continue;
          if (right_hand_side) {
            q[nw + i] += k->force[at];
          } else {
            k->spring[at] = k->stiffness;
            q[nw + i] += k->z[at] - k->stiffness * (k->active[at] < 0 ? k->low[at] : k->high[at]);
            U[(nw + i) * n + nw + i] += k->stiffness;
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
            for (int b = a; b < n; b++) U[a * n + b] += stiff * row[a] * row[b];
        }
        for (int l = 0; l < n; l++) q[l] += row[l] * force;
      }
    }
    if (k->barrier) {
      const double *push = right_hand_side ? k->force : k->barrier_force;
      for (int i = 0; i < nx + nw + (slot ? 0 : np); i++) {
        const size_t at = i < nw        ? k->fw + (size_t)(slot * nw + i)
                          : i < nw + nx ? (size_t)(slot * nx + i - nw)
                                        : k->fp + (size_t)(i - nw - nx);
        if (k->active[at]) continue;
        q[i] += push[at];
        if (!right_hand_side) U[i * n + i] += k->barrier_spring[at];
      }
      for (int i = 0; i < nb; i++) {
        const size_t at = k->fy + (size_t)(slot * nb + i);
        const double *row = J + (nx + i) * n, stiff = k->barrier_spring[at];
        if (k->active[at]) continue;
        for (int l = 0; l < n; l++) q[l] += row[l] * push[at];
        if (!right_hand_side && stiff > 0.0)
          for (int a = 0; a < n; a++)
            for (int b = a; b < n; b++) U[a * n + b] += stiff * row[a] * row[b];
      }
    }
    if (!right_hand_side) {
      if (k->damping > 0.0)
        for (int i = 0; i < nw + nx; i++) U[i * n + i] += k->damping;
      if (k->damping > 0.0 && slot == 0)
        for (int i = nw + nx; i < n; i++) U[i * n + i] += k->damping;
      for (int i = 0; i < n; i++) {
        floor[i] = PIVOT * U[i * n + i];
        skip[i] = 0;
      }
      if (k->bounded && eliminated) {
        for (int j = 0; j < eliminated; j++) {
          const size_t at = j < nw ? k->fw + (size_t)(slot * nw + j)
                                   : j < nw + nx ? (size_t)(j - nw) : k->fp + (size_t)(j - nw - nx);
          if (!k->active[at]) continue;
          const double target = k->active[at] < 0 ? k->low[at] : k->high[at];
          for (int i = 0; i < n; i++) q[i] += (i < j ? U[i * n + j] : U[j * n + i]) * target;
          skip[j] = 1;
        }
        for (int j = 0; j < eliminated; j++)
          if (skip[j]) {
            for (int i = 0; i < j; i++) U[i * n + j] = 0.0;
            for (int i = j; i < n; i++) U[j * n + i] = 0.0;
          }
      }
      const int outcome =
          k->plain ? eliminate_plain(U, D, floor, skip, eliminated, n) : cholesky(U, D, floor, skip, n);
      if (outcome == NOT_A_NUMBER) return outcome;
      if (outcome) status = outcome;
    }
    forward_eliminate(q, U, D, eliminated, n);
  }
  return status;
}

static int backward(core *k, const model *m, int from, int right_hand_side) {
  if (right_hand_side) {
    if (k->np) return backward_sized(k, m, from, 1, NX(k->s), NW(k->s), NP(k->s));
    return backward_sized(k, m, from, 1, NX(k->s), NW(k->s), 0);
  }
  if (k->np) return backward_sized(k, m, from, 0, NX(k->s), NW(k->s), NP(k->s));
  return backward_sized(k, m, from, 0, NX(k->s), NW(k->s), 0);
}

/* Solve for `count` leading variables of v, those behind them known. */
INLINE void back_substitute(double *restrict v, const double *restrict U, const double *restrict D,
                            const double *restrict l, int count, int n) {
  for (int j = count - 1; j >= 0; j--) {
    double t = l[j];
    for (int i = j + 1; i < n; i++) t += U[j * n + i] * v[i];
    v[j] = -t * D[j];
  }
}

/* Forward sweep: the step (whole), or a correction added to it. */
INLINE void forward_sized(core *k, const model *m, int correction, int nx, int nw, int np) {
  const int n = nw + nx + np, N = k->N, nb = k->nb;
  const uint8_t *shared = k->win->shared;
  double *restrict v = k->v, *restrict next = k->t, *d = k->d;
  for (int slot = 0; slot < N; slot++) {
    const double *U = k->U + (size_t)slot * (size_t)(n * n), *D = k->D + (size_t)(slot * n),
                 *q = k->q + (size_t)(slot * n);
    const double *J = m->J + (size_t)(slot * (nx + nb)) * (size_t)n, *c = m->c + (size_t)(slot * nx);
    const int first = slot == 0 || !shared[slot - 1];
    const int eliminated = slot == 0 ? n : first ? nw : 0;
    back_substitute(v, U, D, q, eliminated, n);
    if (k->bounded && eliminated && !correction)
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
      double t = 0.0;
      for (int l = 0; l < n; l++) t += J[(nx + i) * n + l] * v[l];
      if (correction) dy[i] += t;
      else dy[i] = t;
    }
    for (int i = 0; i < nx; i++) {
      double t = correction ? 0.0 : c[i];
      for (int l = 0; l < n; l++) t += J[i * n + l] * v[l];
      next[i] = t;
    }
    for (int i = 0; i < nx; i++) v[nw + i] = next[i];
  }
  for (int i = 0; i < nx; i++) {
    if (correction) d[N * nx + i] += v[nw + i];
    else d[N * nx + i] = v[nw + i];
  }
}

static void forward(core *k, const model *m, int correction) {
  if (correction) {
    if (k->np) forward_sized(k, m, 1, NX(k->s), NW(k->s), NP(k->s));
    else forward_sized(k, m, 1, NX(k->s), NW(k->s), 0);
  } else if (k->np) forward_sized(k, m, 0, NX(k->s), NW(k->s), NP(k->s));
  else forward_sized(k, m, 0, NX(k->s), NW(k->s), 0);
}

/* Adjoint sweep at the step: dynamics multipliers, multipliers of the substituted bounds, predicted decrease of J/2,
 * and how stationary the step is. */
INLINE void adjoint_sized(core *k, const model *m, int nx, int nw, int np) {
  const int n = nw + nx + np, N = k->N, nb = k->nb;
  const uint8_t *shared = k->win->shared;
  double *restrict v = k->v, *restrict r = k->r, *restrict Hv = k->t;
  double *rw = k->S, *rp = k->S + nw, *Hp = k->S + nw + np, *gp = k->S + nw + 2 * np;
  const double *d = k->d;
  double slope = 0.0, curvature = 0.0, largest = 0.0, product = 0.0, residual = 0.0, force = 0.0;
  for (int i = 0; i < nw; i++) rw[i] = 0.0;
  for (int i = 0; i < np; i++) {
    rp[i] = k->damping * d[k->fp + (size_t)i];
    Hp[i] = gp[i] = 0.0;
  }
  for (int i = 0; i < nx; i++)
    k->lambda[(N - 1) * nx + i] = k->damping * d[N * nx + i] + (k->bounded ? k->z[N * nx + i] : 0.0);
  for (int slot = N - 1; slot >= 0; slot--) {
    const double *H = m->H + (size_t)slot * (size_t)(n * n), *g = m->g + (size_t)(slot * n);
    const double *J = m->J + (size_t)(slot * (nx + nb)) * (size_t)n, *lambda = k->lambda + (size_t)(slot * nx);
    for (int i = 0; i < nw; i++) v[i] = d[k->fw + (size_t)(slot * nw + i)];
    for (int i = 0; i < nx; i++) v[nw + i] = d[(size_t)(slot * nx + i)];
    for (int i = 0; i < np; i++) v[nw + nx + i] = d[k->fp + (size_t)i];
    for (int i = 0; i < n; i++) Hv[i] = 0.0;
    for (int i = 0; i < n; i++) {
      const double vi = v[i], *restrict row = H + i * n;
      double t = row[i] * vi;
      for (int j = i + 1; j < n; j++) {
        t += row[j] * v[j];
        Hv[j] += row[j] * vi;
      }
      Hv[i] += t;
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
    for (int i = 0; i < np; i++) rp[i] += r[nw + nx + i];
    for (int i = 0; i < nw; i++) rw[i] += r[i];
    if (slot == 0 || !shared[slot - 1])
      for (int i = 0; i < nw; i++) {
        const size_t at = k->fw + (size_t)(slot * nw + i);
        if (k->bounded && k->active[at]) k->z[at] = -rw[i];
        else if (fabs(rw[i]) > residual) residual = fabs(rw[i]);
        rw[i] = 0.0;
      }
    if (slot == 0) {
      for (int i = 0; i < nx; i++) {
        if (k->bounded && k->active[i]) k->z[i] = -r[nw + i];
        else if (fabs(r[nw + i]) > residual) residual = fabs(r[nw + i]);
      }
    } else {
      double *before = k->lambda + (size_t)((slot - 1) * nx);
      if (k->bounded)
        for (int i = 0; i < nx; i++) before[i] = r[nw + i] + k->z[slot * nx + i];
      else
        for (int i = 0; i < nx; i++) before[i] = r[nw + i];
    }
  }
  for (int i = 0; i < np; i++) {
    const size_t at = k->fp + (size_t)i;
    if (k->bounded && k->active[at]) k->z[at] = -rp[i];
    else if (fabs(rp[i]) > residual) residual = fabs(rp[i]);
    if (fabs(gp[i]) > largest) largest = fabs(gp[i]);
    if (fabs(Hp[i]) > product) product = fabs(Hp[i]);
  }
  if (force > largest) largest = force;
  k->decrease = -(slope + curvature / 2);
  k->optimality = product / (largest > 1e-300 ? largest : 1e-300);
  if (product > largest) largest = product;
  k->stationarity = residual / (largest > 1e-300 ? largest : 1e-300);
}

static void adjoint(core *k, const model *m) {
  if (k->np) adjoint_sized(k, m, NX(k->s), NW(k->s), NP(k->s));
  else adjoint_sized(k, m, NX(k->s), NW(k->s), 0);
}

/* ---- The quadratic program with its bounds ------------------------------------------------------------------ */

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
  for (int attempt = 0; attempt < 4; attempt++) {
    int status = backward(k, m, from, 0);
    if (status) return status;
    forward(k, m, 0);
    if (!k->bounded) {
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

static double spring_constant(const core *k, const model *m);

/* Mehrotra's predictor-corrector on all bounds that are not equalities; leaves the active set it finds. */
static int interior_point(core *k, const model *m, int *factorizations) {
  const size_t nf = k->nf;
  double *centre_high = k->barrier_force + nf, *centre_low = centre_high + nf;
  const double curvature = spring_constant(k, m) / STIFFNESS;
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
  adjoint(k, m);
  return OK;
}

/* ---- The outer iteration ------------------------------------------------------------------------------------ */

INLINE double clip(double value, double low, double high) {
  return value < low ? low : value > high ? high : value; /* a NaN stays */
}

static void prepare(core *k, const ctmhe_result *guess) {
  const ctmhe_stage *s = k->s;
  const ctmhe_window *win = k->win;
  const int nx = NX(s), nw = NW(s), ny = NY(s), q = NQ(s), np = k->np, N = k->N, nb = k->nb, width = nx + np;
  for (int i = 0; i < nw; i++) k->scale[i] = win->w_scale[i];
  for (int i = 0; i < nx; i++) k->scale[nw + i] = win->x_scale[i], k->inverse_x[i] = 1.0 / win->x_scale[i];
  for (int i = 0; i < np; i++) k->scale[nw + nx + i] = win->p_scale[i];
  for (int i = 0; i < nx; i++) k->inverse[i] = 1.0 / win->x_scale[i];
  for (int i = 0; i < nw; i++) k->inverse[nx + i] = 1.0 / win->w_scale[i];
  for (int i = 0; i < nb; i++) k->inverse[nx + nw + i] = 1.0 / win->y_scale[i];
  for (int i = 0; i < np; i++) k->inverse[nx + nw + nb + i] = 1.0 / win->p_scale[i];
  for (int i = 0; i < width; i++)
    for (int j = 0; j < width; j++) {
      double t = 0.0;
      for (int r = 0; r < width; r++) t += win->L_prior[r * width + i] * win->L_prior[r * width + j];
      k->P[i * width + j] = t * k->scale[nw + i] * k->scale[nw + j];
    }
  for (int slot = 0; slot < N; slot++) {
    const double *L = win->L_w + (size_t)slot * (size_t)(nw * nw);
    double *W = k->W + (size_t)slot * (size_t)(nw * nw);
    int kind = ZERO;
    for (int i = 0; i < nw; i++)
      for (int j = 0; j < nw; j++)
        if (L[i * nw + j] != 0.0) kind = i == j && kind != DENSE ? DIAGONAL : DENSE;
    k->kind_w[slot] = (uint8_t)kind;
    if (kind == DENSE) {
      for (int i = 0; i < nw; i++)
        for (int j = 0; j < nw; j++) {
          double t = 0.0;
          for (int r = 0; r < nw; r++) t += L[r * nw + i] * L[r * nw + j];
          W[i * nw + j] = t * k->scale[i] * k->scale[j];
        }
    } else {
      for (int i = 0; i < nw; i++) {
        const double root = L[i * nw + i] * k->scale[i];
        W[i * nw + i] = root * root;
      }
    }
    for (int point = 0; point < q; point++) {
      const double *Ly = win->L_y + (size_t)(slot * q + point) * (size_t)(ny * ny);
      kind = ZERO;
      for (int i = 0; i < ny; i++)
        for (int j = 0; j < ny; j++)
          if (Ly[i * ny + j] != 0.0) kind = i == j && kind != DENSE ? DIAGONAL : DENSE;
      k->kind_y[slot * q + point] = (uint8_t)kind;
    }
  }
  /* bounds, without those on copies: w of a slot that shares it with the one before, x behind a slot of no length */
  k->bounded = 0;
  for (int slot = 0; slot <= N; slot++) {
    const int still = slot > 0 && win->h[slot - 1] == 0.0;
    for (int i = 0; i < nx; i++) {
      const size_t at = (size_t)(slot * nx + i);
      k->lower[at] = still ? -HUGE_VAL : win->x_lower[at];
      k->upper[at] = still ? HUGE_VAL : win->x_upper[at];
      k->active[at] = guess->x_active[at];
    }
    if (slot == N) break;
    const int tied = slot > 0 && win->shared[slot - 1];
    for (int i = 0; i < nw; i++) {
      const size_t from = (size_t)(slot * nw + i), at = k->fw + from;
      k->lower[at] = tied ? -HUGE_VAL : win->w_lower[from];
      k->upper[at] = tied ? HUGE_VAL : win->w_upper[from];
      k->active[at] = guess->w_active[from];
    }
    for (int i = 0; i < nb; i++) {
      const size_t from = (size_t)(slot * nb + i), at = k->fy + from;
      k->lower[at] = win->y_lower[from];
      k->upper[at] = win->y_upper[from];
      k->active[at] = guess->y_active[from];
    }
  }
  for (int i = 0; i < np; i++) {
    const size_t at = k->fp + (size_t)i;
    k->lower[at] = win->p_lower[i];
    k->upper[at] = win->p_upper[i];
    k->active[at] = guess->p_active[i];
  }
  for (size_t at = 0; at < k->nf; at++) {
    const double low = k->lower[at], high = k->upper[at];
    const int has_low = low > -HUGE_VAL, has_high = high < HUGE_VAL;
    if (has_low || has_high) k->bounded = 1;
    k->fixed[at] = (uint8_t)(low == high);
    const int8_t held = k->active[at];
    if (k->fixed[at]) k->active[at] = 1;
    else if (held) k->active[at] = held < 0 ? (has_low ? -1 : 0) : (has_high ? 1 : 0);
    k->z[at] = 0.0;
    k->d[at] = 0.0;
  }
  k->stiffness = 0.0;
}

/* Bounds relative to the point, scaled. */
static void relative_bounds(core *k, const model *m) {
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

static void move(const core *k, const model *from, model *to, double alpha) {
  const ctmhe_window *win = k->win;
  const int nx = NX(k->s), nw = NW(k->s), N = k->N;
  const double *d = k->d;
  for (int slot = 0; slot <= N; slot++)
    for (int i = 0; i < nx; i++) {
      const size_t at = (size_t)(slot * nx + i);
      to->x[at] = clip(from->x[at] + alpha * d[at] * win->x_scale[i], win->x_lower[at], win->x_upper[at]);
    }
  for (int slot = 0; slot < N; slot++)
    for (int i = 0; i < nw; i++) {
      const size_t at = (size_t)(slot * nw + i);
      to->w[at] =
          clip(from->w[at] + alpha * d[k->fw + at] * win->w_scale[i], win->w_lower[at], win->w_upper[at]);
    }
  for (int i = 0; i < NP(k->s); i++)
    to->p[i] = k->np ? clip(from->p[i] + alpha * d[k->fp + (size_t)i] * win->p_scale[i], win->p_lower[i],
                            win->p_upper[i])
                     : from->p[i];
}

/* The predicted decrease that is small enough to stop: relative to the cost, or below round-off. */
static double enough(const ctmhe_options *options, double cost, double data) {
  return options->tolerance * cost + ROUND_OFF * sqrt(cost * data) + options->accuracy * options->accuracy * data;
}

/* The largest component of the step, relative to the signals' scales. */
static double largest_step(const core *k) {
  double largest = 0.0;
  const size_t states = (size_t)((k->N + 1) * NX(k->s)), disturbances = (size_t)(k->N * NW(k->s));
  for (size_t i = 0; i < states; i++)
    if (fabs(k->d[i]) > largest) largest = fabs(k->d[i]);
  for (size_t i = 0; i < disturbances; i++)
    if (fabs(k->d[k->fw + i]) > largest) largest = fabs(k->d[k->fw + i]);
  for (size_t i = 0; i < (size_t)k->np; i++)
    if (fabs(k->d[k->fp + i]) > largest) largest = fabs(k->d[k->fp + i]);
  return largest;
}

static double data_scale(const core *k) {
  const ctmhe_window *win = k->win;
  const int ny = NY(k->s), q = NQ(k->s), width = NX(k->s) + k->np;
  double total = 1e-300;
  for (int at = 0; at < k->N * q; at++)
    for (int i = 0; k->kind_y[at] && i < ny; i++) {
      double r = 0.0;
      for (int j = 0; j < ny; j++)
        r += win->L_y[((size_t)at * (size_t)ny + (size_t)i) * (size_t)ny + (size_t)j] * win->y_data[at * ny + j];
      total += r * r;
    }
  for (int i = 0; i < width; i++) {
    double r = 0.0;
    for (int j = 0; j < width; j++) r += win->L_prior[i * width + j] * win->prior[j];
    total += r * r;
  }
  return total;
}

static double worst_bound(const core *k, const model *m) {
  const ctmhe_window *win = k->win;
  const int nx = NX(k->s), nw = NW(k->s), ny = NY(k->s), q = NQ(k->s), N = k->N;
  double worst = 0.0;
#define CHECK(value, low, high, scale)                          \
  do {                                                          \
    double over = (low) - (value), above = (value) - (high);    \
    if (above > over) over = above;                             \
    if (over > 0.0 && over / (scale) > worst) worst = over / (scale); \
  } while (0)
  for (int slot = 0; slot <= N; slot++)
    for (int i = 0; i < nx; i++) {
      const size_t at = (size_t)(slot * nx + i);
      CHECK(m->x[at], win->x_lower[at], win->x_upper[at], win->x_scale[i]);
    }
  for (int slot = 0; slot < N; slot++) {
    for (int i = 0; i < nw; i++) {
      const size_t at = (size_t)(slot * nw + i);
      CHECK(m->w[at], win->w_lower[at], win->w_upper[at], win->w_scale[i]);
    }
    for (int i = 0; i < ny && k->nb; i++)
      CHECK(m->y[(slot * q + q - 1) * ny + i], win->y_lower[slot * ny + i], win->y_upper[slot * ny + i],
            win->y_scale[i]);
  }
  for (int i = 0; i < NP(k->s); i++) CHECK(m->p[i], win->p_lower[i], win->p_upper[i], win->p_scale[i]);
#undef CHECK
  return worst;
}

static void hand_over(core *k, const model *m, ctmhe_result *result, int stepped) {
  const int nx = NX(k->s), nw = NW(k->s), ny = NY(k->s), q = NQ(k->s), N = k->N;
  copy(result->x, m->x, (size_t)((N + 1) * nx));
  copy(result->w, m->w, (size_t)(N * nw));
  copy(result->p, m->p, (size_t)NP(k->s));
  copy(result->y, m->y, (size_t)(N * q * ny));
  result->cost = m->cost;
  const double bound = worst_bound(k, m);
  result->feasibility = m->defect > bound ? m->defect : bound;
  copy(result->dynamics_multiplier, k->lambda, (size_t)(N * nx));
  memset(result->y_active, 0, (size_t)(N * ny));
  memset(result->p_active, 0, (size_t)NP(k->s));
  memset(result->y_multiplier, 0, sizeof(double) * (size_t)(N * ny));
  memset(result->p_multiplier, 0, sizeof(double) * (size_t)NP(k->s));
  if (nx) memcpy(result->x_active, k->active, (size_t)((N + 1) * nx));
  if (nw) memcpy(result->w_active, k->active + k->fw, (size_t)(N * nw));
  if (k->nb) memcpy(result->y_active, k->active + k->fy, (size_t)(N * k->nb));
  if (k->np) memcpy(result->p_active, k->active + k->fp, (size_t)k->np);
  for (size_t at = 0; at < k->nf; at++)
    if (!k->active[at] || !stepped) k->z[at] = 0.0;
  copy(result->x_multiplier, k->z, (size_t)((N + 1) * nx));
  copy(result->w_multiplier, k->z + k->fw, (size_t)(N * nw));
  copy(result->y_multiplier, k->z + k->fy, (size_t)(N * k->nb));
  copy(result->p_multiplier, k->z + k->fp, (size_t)k->np);
}

static double largest_force(const core *k) {
  double largest = 0.0;
  for (int i = 0; i < k->N * NX(k->s); i++)
    if (fabs(k->lambda[i]) > largest) largest = fabs(k->lambda[i]);
  for (size_t at = k->fy; at < k->fp; at++)
    if (k->active[at] && fabs(k->z[at]) > largest) largest = fabs(k->z[at]);
  return largest;
}

int ctmhe_solve(const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_options *options,
                ctmhe_result *result, void *scratch) {
  core memory, *k = &memory;
  const int nx = NX(stage), nw = NW(stage), N = window->n;
  k->s = stage;
  k->win = window;
  k->N = N;
  k->np = window->p_estimated ? NP(stage) : 0;
  k->n = nw + nx + k->np;
  k->nb = window->output_bounded ? NY(stage) : 0;
  lay_out(k, scratch, stage, N, k->np, k->nb);
  prepare(k, result);
  k->damping = 0.0;
  for (int i = 0; i < N * nx; i++) k->lambda[i] = 0.0;
  model *current = &k->a, *trial = &k->b;
  for (int i = 0; i < (N + 1) * nx; i++) current->x[i] = clip(result->x[i], window->x_lower[i], window->x_upper[i]);
  for (int i = 0; i < N * nw; i++) current->w[i] = clip(result->w[i], window->w_lower[i], window->w_upper[i]);
  for (int slot = 0; slot + 1 < N; slot++) /* one w for all slots of a cell */
    if (window->shared[slot])
      for (int i = 0; i < nw; i++) current->w[(slot + 1) * nw + i] = current->w[slot * nw + i];
  for (int i = 0; i < NP(stage); i++)
    current->p[i] = k->np ? clip(result->p[i], window->p_lower[i], window->p_upper[i]) : result->p[i];
  result->iterations = result->factorizations = 0;
  result->optimality = result->feasibility = NAN;
  result->stop = CTMHE_NOT_FINITE;
  result->cost = HUGE_VAL;
  if (linearize(k, current) || !(fabs(current->cost) < HUGE_VAL) || !(current->infeasibility < HUGE_VAL))
    return result->stop;
  const double data = data_scale(k), accuracy = options->accuracy;
  const double feasible = 10 * accuracy > 1e-8 ? 10 * accuracy : 1e-8;
  double recent_cost[MEMORY], recent_infeasibility[MEMORY];
  int remembered = 1, newest = 0;
  recent_cost[0] = current->cost;
  recent_infeasibility[0] = current->infeasibility;
  double rho = 0.0, last_decrease = NAN;
  int newton = 0, with_curvature = 0, stepped = 0, stop = CTMHE_ITERATION_LIMIT, iteration = 0;
  while (iteration < options->max_iterations) {
    iteration++;
    if (k->bounded) {
      relative_bounds(k, current);
      if (k->stiffness == 0.0) k->stiffness = spring_constant(k, current);
    }
    int status = OK;
    if (newton) {
      if (add_curvature(k, current)) status = NOT_A_NUMBER;
      with_curvature = 1;
    }
    k->plain = with_curvature;
    if (status == OK) status = solve_program(k, current, &result->factorizations);
    if (status == OK && k->stationarity > 1e-6) status = INCONSISTENT; /* a gradient where there is no curvature */
    if (status != OK && with_curvature) {
      newton = with_curvature = 0;
      last_decrease = NAN;
      if (linearize(k, current)) return result->stop;
      continue;
    }
    if (status != OK) {
      const double typical = typical_curvature(k, current);
      k->damping = 10 * k->damping > DAMPING_START * typical ? 10 * k->damping : DAMPING_START * typical;
      if (!(k->damping <= DAMPING_LIMIT * typical)) {
        stop = CTMHE_SINGULAR;
        break;
      }
      k->stiffness = 0.0;
      for (size_t at = 0; at < k->nf; at++) {
        k->active[at] = k->fixed[at] ? 1 : 0;
        k->z[at] = 0.0;
      }
      continue;
    }
    stepped = 1;
    result->optimality = k->optimality;
    const double predicted = k->decrease, force = 1.5 * largest_force(k);
    if (force > rho || iteration <= SETTLED) rho = force;
    if (k->damping == 0.0 && current->defect <= feasible && current->excess <= feasible &&
        largest_step(k) <= 100 * accuracy) { /* the step is below what the integrator can tell apart */
      stop = CTMHE_CONVERGED;
      break;
    }
    /* a full step is likely the last: it needs no new linearisation */
    const int last = fabs(predicted) <= enough(options, current->cost, data);
    double merit = -HUGE_VAL; /* the worst of the last few: curved dynamics would cut good full steps */
    for (int i = 0; i < remembered; i++) {
      const double past = recent_cost[i] / 2 + rho * recent_infeasibility[i];
      if (past > merit) merit = past;
    }
    const double slope = -(predicted > 0.0 ? predicted : 0.0) - rho * current->infeasibility;
    const double noise = 1e-13 * (merit > 1e-300 ? merit : 1e-300);
    double alpha = 1.0;
    int accepted = 0, linearized = 0;
    for (int attempt = 0; attempt < 12; attempt++) {
      move(k, current, trial, alpha);
      linearized = attempt == 0 && !last;
      if (linearized ? linearize(k, trial) : assess(k, trial)) {
        alpha /= 4;
        continue;
      }
      const double value = trial->cost / 2 + rho * trial->infeasibility;
      if (fabs(value) < HUGE_VAL && value <= merit + ARMIJO * alpha * slope + noise) {
        accepted = 1;
        break;
      }
      alpha /= 2;
    }
    if (!accepted && with_curvature) {
      newton = with_curvature = 0;
      last_decrease = NAN;
      if (linearize(k, current)) return result->stop;
      continue;
    }
    const double typical = !accepted || k->damping > 0.0 ? typical_curvature(k, current) : 1.0;
    if (!accepted) {
      k->damping = 10 * k->damping > DAMPING_START * typical ? 10 * k->damping : DAMPING_START * typical;
      if (!(k->damping <= DAMPING_LIMIT * typical)) {
        stop = CTMHE_NO_DECREASE;
        break;
      }
      continue;
    }
    const int light = k->damping <= 10 * DAMPING_START * typical; /* else the small step is the damping's doing */
    k->damping = k->damping < DAMPING_START * typical ? 0.0 : 0.1 * k->damping;
    const int slow = iteration > 4 && fabs(predicted) > SLOW * fabs(last_decrease);
    newton = stage->symbolic && alpha == 1.0 && (newton || slow);
    last_decrease = predicted;
    model *accepted_model = trial;
    trial = current;
    current = accepted_model;
    with_curvature = 0;
    newest = (newest + 1) % MEMORY;
    if (remembered < MEMORY) remembered++;
    recent_cost[newest] = current->cost;
    recent_infeasibility[newest] = current->infeasibility;
    if (fabs(predicted) <= enough(options, current->cost, data) && alpha == 1.0 && light &&
        current->defect <= feasible && current->excess <= feasible) {
      stop = CTMHE_CONVERGED;
      break;
    }
    if (!linearized && linearize(k, current)) return result->stop;
  }
  result->iterations = iteration;
  hand_over(k, current, result, stepped);
  result->stop = stop;
  return stop;
}
