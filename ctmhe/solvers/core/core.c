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
#include "model.h"
#include "program.h"
#include "covariance.h"
#include "update.h"

#define STATIONARY 1e-6 /* residual of a step, relative, up to which it minimises the quadratic program */

#define HIDDEN 5.0 /* what defects may hide of J/2, against the decrease that is small enough to stop */
#define SHORT 0.1 /* share of a step, below which the next is damped more */

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
  for (int i = 0; i < nx; i++)
    for (int j = 0; j < k->n; j++) k->factor[i * k->n + j] = k->inverse_x[i] * k->scale[j];
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

/* The remaining decrease that is small enough to stop: relative to the cost, or below round-off. */
static double enough(const ctmhe_options *options, double cost, double data, double unit) {
  return options->tolerance * cost + ROUND_OFF * sqrt(cost * data) + options->accuracy * options->accuracy * data +
         ROUND_OFF * ROUND_OFF * unit;
}

/* What the defects at a point hide of J/2, to first order: as the multipliers price them. */
static double price_of_defects(const core *k, const model *m) {
  double price = 0.0;
  for (size_t i = 0; i < (size_t)k->N * (size_t)NX(k->s); i++) price += k->lambda[i] * m->c[i];
  return price;
}

/* How far the quadratic model was off along a full step, relative to its own curvature there: to first order what the
 * next Gauss-Newton step is against this one. */
static double contraction(const core *k, const model *from, const model *to, double price) {
  const double error = to->cost / 2 - from->cost / 2 + k->decrease + price;
  return k->curvature > 0.0 ? 2.0 * fabs(error) / k->curvature : 1.0;
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

/* The cost of explaining nothing, what round-off in the residuals is relative to, and in `unit` that of residuals as
 * large as the signals' scales: where the data are zero, round-off is relative to these. */
static double data_scale(const core *k, double *unit) {
  const ctmhe_window *win = k->win;
  const int nw = NW(k->s), ny = NY(k->s), q = NQ(k->s), width = NX(k->s) + k->np;
  double total = 1e-300, units = 0.0;
  for (int at = 0; at < k->N * q; at++)
    for (int i = 0; k->kind_y[at] && i < ny; i++) {
      double r = 0.0;
      for (int j = 0; j < ny; j++) {
        const double l = win->L_y[((size_t)at * (size_t)ny + (size_t)i) * (size_t)ny + (size_t)j];
        r += l * win->y_data[at * ny + j];
        units += l * l * win->y_scale[j] * win->y_scale[j];
      }
      total += r * r;
    }
  for (int slot = 0; slot < k->N; slot++)
    for (int i = 0; i < nw; i++) units += k->W[(size_t)slot * (size_t)(nw * nw) + (size_t)(i * (nw + 1))];
  for (int i = 0; i < width; i++) {
    double r = 0.0;
    for (int j = 0; j < width; j++) r += win->L_prior[i * width + j] * win->prior[j];
    total += r * r;
    units += k->P[i * (width + 1)];
  }
  *unit = units;
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

/* A prepared window: what its linearisation depends on, the point apart, which is in k->a. */
#define FOR_ARRAYS_OF_SLOTS(use)                                                                            \
  use(h, 1) use(u0, nu) use(u1, nu) use(L_w, nw * nw) use(L_y, q * ny * ny) use(y_data, q * ny) use(shared, 1) \
  if (k->nb) {                                                                                              \
    use(y_lower, ny) use(y_upper, ny)                                                                       \
  }

static void remember(core *k, int factorized) {
  const ctmhe_stage *s = k->s;
  const ctmhe_window *win = k->win;
  const size_t N = (size_t)k->N, nu = (size_t)s->nu, nw = (size_t)NW(s), ny = (size_t)NY(s), q = (size_t)NQ(s);
  const size_t width = (size_t)(NX(s) + k->np);
  memo *m = k->memo;
#define REMEMBER(name, size) memcpy(m->name, win->name, sizeof *m->name * N * (size));
  FOR_ARRAYS_OF_SLOTS(REMEMBER)
#undef REMEMBER
  copy(m->t, win->t, N + 1);
  copy(m->prior, win->prior, width);
  copy(m->L_prior, win->L_prior, width * width);
  m->N = k->N, m->np = k->np, m->nb = k->nb;
  m->factorized = factorized;
  m->valid = 1;
}

static void mark_stale(core *k) {
  const ctmhe_stage *s = k->s;
  const ctmhe_window *win = k->win;
  const size_t N = (size_t)k->N, nu = (size_t)s->nu, nw = (size_t)NW(s), ny = (size_t)NY(s), q = (size_t)NQ(s);
  const size_t width = (size_t)(NX(s) + k->np);
  const memo *m = k->memo;
  memset(k->stale, 0, N);
#define MARK(name, size)                                                                                     \
  if (memcmp(m->name, win->name, sizeof *m->name * N * (size)))                                              \
    for (size_t slot = 0; slot < N; slot++)                                                                  \
      if (memcmp(m->name + slot * (size), win->name + slot * (size), sizeof *m->name * (size))) k->stale[slot] = 1;
  FOR_ARRAYS_OF_SLOTS(MARK)
  MARK(t, 1)
#undef MARK
  if (memcmp(m->prior, win->prior, sizeof(double) * width) ||
      memcmp(m->L_prior, win->L_prior, sizeof(double) * width * width))
    k->stale[0] = 1;
  for (size_t slot = 0; slot + 1 < N; slot++) /* who carries w changes its neighbour's factors too */
    if (m->shared[slot] != win->shared[slot]) k->stale[slot + 1] = 1, k->memo->factorized = 0;
}

/* Take a window up: memory, what the sweeps need of it, and the guess in k->a, moved into the bounds. With `prepared`,
 * mark what differs from the window in memory and return whether anything of it can be used. */
static int take_up(core *k, const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_result *guess,
                   void *scratch, int prepared) {
  const int nx = NX(stage), nw = NW(stage), N = window->n;
  k->s = stage;
  k->win = window;
  k->N = N;
  k->np = window->p_estimated ? NP(stage) : 0;
  k->n = nw + nx + k->np;
  k->nb = window->output_bounded ? NY(stage) : 0;
  lay_out(k, scratch, stage, N, k->np, k->nb);
  const memo *known = k->memo;
  prepared = prepared && known->valid && known->N == N && known->np == k->np && known->nb == k->nb;
  uint8_t *stale = k->stale;
  if (prepared) mark_stale(k);
  prepare(k, guess);
  k->damping = 0.0;
  k->rebuilt = N;
  for (int i = 0; i < N * nx; i++) k->lambda[i] = 0.0;
  double *x = k->a.x, *w = k->a.w, *p = k->a.p;
  for (int i = 0; i < (N + 1) * nx; i++) {
    const double value = clip(guess->x[i], window->x_lower[i], window->x_upper[i]);
    if (prepared && value != x[i]) {
      if (i < N * nx) stale[i / nx] = 1;
      if (i >= nx) stale[i / nx - 1] = 1;
    }
    x[i] = value;
  }
  for (int slot = 0; slot < N; slot++)
    for (int i = 0; i < nw; i++) {
      const int at = slot * nw + i, from = slot && window->shared[slot - 1] ? at - nw : at; /* one w a cell */
      const double value = from == at ? clip(guess->w[at], window->w_lower[at], window->w_upper[at]) : w[from];
      if (prepared && value != w[at]) stale[slot] = 1;
      w[at] = value;
    }
  for (int i = 0; i < NP(stage); i++) {
    const double value = k->np ? clip(guess->p[i], window->p_lower[i], window->p_upper[i]) : guess->p[i];
    if (prepared && value != p[i]) memset(stale, 1, (size_t)N);
    p[i] = value;
  }
  if (!prepared) k->stale = NULL;
  return prepared;
}

static int solve(const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_options *options,
                 ctmhe_result *result, void *scratch, int prepared) {
  core memory, *k = &memory;
  prepared = take_up(k, stage, window, result, scratch, prepared);
  const int factorized = prepared && k->memo->factorized;
  k->memo->valid = 0;
  if (factorized) k->rebuilt = -1;
  model *current = &k->a, *trial = &k->b;
  result->iterations = result->factorizations = 0;
  result->optimality = result->feasibility = NAN;
  result->stop = CTMHE_NOT_FINITE;
  result->cost = HUGE_VAL;
  if (linearize(k, current) || !(fabs(current->cost) < HUGE_VAL) || !(current->infeasibility < HUGE_VAL))
    return result->stop;
  k->stale = NULL;
  if (!factorized) k->rebuilt = window->n;
  double unit;
  const double data = data_scale(k, &unit), accuracy = options->accuracy;
  const double feasible = 10 * accuracy > 1e-8 ? 10 * accuracy : 1e-8;
  double recent_cost[MEMORY], recent_infeasibility[MEMORY];
  int remembered = 1, newest = 0;
  recent_cost[0] = current->cost;
  recent_infeasibility[0] = current->infeasibility;
  double rho = 0.0, last_decrease = NAN, last_gain = 0.0;
  int rooted = 0, newton = 0, with_curvature = 0, stepped = 0, stop = CTMHE_ITERATION_LIMIT, iteration = 0;
  const int limited = options->seconds > 0.0 && options->clock;
  const double began = limited ? options->clock() : 0.0;
  while (iteration < options->max_iterations) {
    if (limited && iteration && options->clock() - began >= options->seconds) {
      stop = CTMHE_DEADLINE;
      break;
    }
    iteration++;
    k->relative = 0;
    int status = OK;
    if (newton) {
      if (add_curvature(k, current)) status = NOT_A_NUMBER;
      with_curvature = 1;
    }
    k->plain = with_curvature || !rooted;
    if (status == OK) status = solve_program(k, current, &result->factorizations);
    if (!rooted && !with_curvature && (status != OK || k->stationarity > ROUGH)) { /* once more, with roots */
      rooted = 1;
      iteration--;
      k->stiffness = 0.0;
      continue;
    }
    /* A gradient that is left over: with second derivatives, one where there is no curvature. Else the recursion has
     * lost digits to an unstable model far from the solution, and the step is a step all the same: it meets the
     * linearised dynamics, and the decrease is predicted at the step as it is. It may not be the last. */
    const int exact = k->stationarity <= STATIONARY;
    if (status == OK && !exact && with_curvature) status = INCONSISTENT;
    if (status != OK && with_curvature) {
      newton = with_curvature = 0;
      last_decrease = NAN, last_gain = 0.0;
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
    const double gain = fabs(predicted) > k->curvature / 2 ? fabs(predicted) : k->curvature / 2;
    const double rate = gain < last_gain ? gain / last_gain : 1.0; /* at which the gains shrink */
    if (force > rho || iteration <= SETTLED) rho = force;
    if (k->damping == 0.0 && exact && current->defect <= feasible && current->excess <= feasible &&
        largest_step(k) <= 100 * accuracy) { /* the step is below what the integrator can tell apart */
      stop = CTMHE_CONVERGED;
      break;
    }
    /* a full step is likely the last: it needs no new linearisation */
    const int last = iteration == options->max_iterations ||
                     (exact && rate * gain <= enough(options, current->cost, data, unit));
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
      last_decrease = NAN, last_gain = 0.0;
      if (linearize(k, current)) return result->stop;
      continue;
    }
    const int stunted = !accepted || alpha < SHORT; /* the linear model does not reach that far: a shorter step next */
    const double typical = stunted || k->damping > 0.0 ? typical_curvature(k, current) : 1.0;
    const double raised = 10 * k->damping > DAMPING_START * typical ? 10 * k->damping : DAMPING_START * typical;
    if (!accepted) {
      k->damping = raised;
      if (!(k->damping <= DAMPING_LIMIT * typical)) {
        stop = CTMHE_NO_DECREASE;
        break;
      }
      continue;
    }
    const int light = k->damping <= 10 * DAMPING_START * typical; /* else the small step is the damping's doing */
    if (stunted) k->damping = raised < DAMPING_LIMIT * typical ? raised : k->damping;
    else k->damping = k->damping < DAMPING_START * typical ? 0.0 : 0.1 * k->damping;
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
    last_gain = alpha == 1.0 && light ? gain : 0.0;
    if (alpha == 1.0 && light && exact && current->defect <= feasible && current->excess <= feasible) {
      const double price = price_of_defects(k, current), off = contraction(k, trial, current, price);
      const double left = enough(options, current->cost, data, unit);
      if (gain * (off * off > rate ? off * off : rate) <= left &&
          (fabs(price) <= HIDDEN * left || current->defect <= 10 * accuracy)) {
        stop = CTMHE_CONVERGED;
        break;
      }
    }
    if (!linearized && iteration < options->max_iterations && linearize(k, current)) return result->stop;
  }
  result->iterations = iteration;
  hand_over(k, current, result, stepped);
  result->stop = stop;
  return stop;
}

int ctmhe_solve(const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_options *options,
                ctmhe_result *result, void *scratch) {
  return solve(stage, window, options, result, scratch, 0);
}

/* ---- Updates ------------------------------------------------------------------------------------------------ */

size_t ctmhe_update_size(const ctmhe_stage *stage, int capacity) {
  assembly a;
  return lay_out_assembly(&a, NULL, stage, capacity);
}

int ctmhe_assemble(const ctmhe_stage *stage, const ctmhe_estimator *estimator, ctmhe_request *request,
                   ctmhe_window *window, ctmhe_result *result, void *scratch) {
  assembly a;
  return assemble(&a, stage, estimator, request, window, result, scratch);
}

int ctmhe_prepare(const ctmhe_stage *stage, const ctmhe_estimator *estimator, ctmhe_request *request,
                  ctmhe_window *window, ctmhe_result *result, void *scratch) {
  assembly a;
  core memory, *k = &memory;
  const int outcome = assemble(&a, stage, estimator, request, window, result, scratch);
  if (outcome) return outcome;
  take_up(k, stage, window, result, a.solve, 0);
  k->memo->valid = 0;
  if (linearize(k, &k->a)) return CTMHE_NOT_FINITE;
  k->calm = !any_held(k);
  k->plain = 1;
  k->barrier = 0;
  remember(k, k->calm && backward(k, &k->a, k->N, 0) == OK);
  return 0;
}

int ctmhe_update(const ctmhe_stage *stage, const ctmhe_estimator *estimator, ctmhe_request *request,
                 const ctmhe_options *options, ctmhe_window *window, ctmhe_result *result, void *scratch) {
  assembly a;
  const int outcome = assemble(&a, stage, estimator, request, window, result, scratch);
  if (outcome) return outcome;
  const int stop = solve(stage, window, options, result, a.solve, request->prepared);
  if (stop == CTMHE_CONVERGED || stop == CTMHE_ITERATION_LIMIT || stop == CTMHE_DEADLINE)
    write_path(&a, window, result, request);
  return stop;
}
