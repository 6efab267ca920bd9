/* One update of an estimator: window and warm start from the logs, then the solve. The same as assembly.py, grid.py,
 * priors.py and guesses.py, in one call without Python; what it does not cover it leaves to them (CTMHE_ELSEWHERE). */
#ifndef CTMHE_UPDATE_H
#define CTMHE_UPDATE_H

#include "slot.h"

typedef struct {
  const ctmhe_stage *s;
  const ctmhe_estimator *e;
  const ctmhe_request *r;
  int n;                        /* slots */
  double tolerance;             /* seconds: closer instants are the same */
  double *edge;                 /* (capacity + 2) */
  double *h;
  uint8_t *shared, *known;      /* known: (n, ny) output known at the slot's end */
  double *L_prior, *L_w, *L_y, *y_data, *count;
  double *x_lower, *x_upper, *w_lower, *w_upper, *y_lower, *y_upper;
  double *cursor, *work, *input; /* next expiry of each sensor; one evaluation of a slot; an input */
  int *row, *steps;             /* steps: of each slot */
  double *solve;                /* scratch of ctmhe_solve */
} assembly;

static size_t lay_out_assembly(assembly *a, char *scratch, const ctmhe_stage *s, int capacity) {
  const size_t n = (size_t)capacity, nx = (size_t)s->nx, nw = (size_t)s->nw, np = (size_t)s->np, ny = (size_t)s->ny;
  const size_t q = (size_t)s->q, m = nx + np;
  arena memory = {scratch, 0};
  a->edge = DOUBLES(&memory, n + 2);
  a->h = DOUBLES(&memory, n);
  a->L_prior = DOUBLES(&memory, m * m);
  a->L_w = DOUBLES(&memory, n * nw * nw);
  a->L_y = DOUBLES(&memory, n * q * ny * ny);
  a->y_data = DOUBLES(&memory, n * q * ny);
  a->count = DOUBLES(&memory, n * ny);
  a->x_lower = DOUBLES(&memory, (n + 1) * nx);
  a->x_upper = DOUBLES(&memory, (n + 1) * nx);
  a->w_lower = DOUBLES(&memory, n * nw);
  a->w_upper = DOUBLES(&memory, n * nw);
  a->y_lower = DOUBLES(&memory, n * ny);
  a->y_upper = DOUBLES(&memory, n * ny);
  a->cursor = DOUBLES(&memory, ny + 1);
  a->work = DOUBLES(&memory, nx + q * ny + step_work_size(s, 0));
  a->input = DOUBLES(&memory, s->nu);
  a->row = take(&memory, sizeof(int) * (ny + 1));
  a->steps = take(&memory, sizeof(int) * n);
  a->shared = take(&memory, n);
  a->known = take(&memory, n * ny + 1);
  a->solve = take(&memory, ctmhe_scratch_size(s, capacity));
  return memory.used;
}

/* ---- The mesh ----------------------------------------------------------------------------------------------- */

static double same_time(double interval, double t) {
  const double size = fabs(t), spacing = nextafter(size, HUGE_VAL) - size;
  const double relative = 1e-9 * interval, absolute = 8.0 * spacing;
  return relative > absolute ? relative : absolute;
}

/* Whether a row of measurements says anything: about any sensor, or about those that are not held. */
static int speaks(const assembly *a, int row, int point_only) {
  const double *y = a->r->y + (size_t)row * (size_t)NY(a->s);
  for (int i = 0; i < NY(a->s); i++)
    if (y[i] == y[i] && !(point_only && a->e->held[i])) return 1;
  return 0;
}

/* Move a held sensor's cursor to its next expiry: its sample stops counting because no newer one has come. */
static void next_expiry(assembly *a, int sensor) {
  const ctmhe_request *r = a->r;
  int i = a->row[sensor];
  a->cursor[sensor] = HUGE_VAL;
  while (i < r->y_count && r->y[i * NY(a->s) + sensor] != r->y[i * NY(a->s) + sensor]) i++;
  while (i < r->y_count) {
    int j = i + 1;
    while (j < r->y_count && r->y[j * NY(a->s) + sensor] != r->y[j * NY(a->s) + sensor]) j++;
    const double end = r->y_t[i] + a->e->hold_limit;
    i = j;
    if (j == r->y_count || r->y_t[j] > end) {
      a->cursor[sensor] = end;
      break;
    }
  }
  a->row[sensor] = i;
}

/* Fill the edges; returns the number of slots, also where it exceeds the capacity. */
static int mesh_edges(assembly *a, int *at_start) {
  const ctmhe_estimator *e = a->e;
  const ctmhe_request *r = a->r;
  const double start = r->start, end = r->end, interval = e->interval, tolerance = a->tolerance;
  const int capacity = r->capacity;
  int filled = 0;
#define EDGE(t)                                        \
  do {                                                 \
    if (filled < capacity + 1) a->edge[filled] = (t);  \
    filled++;                                          \
  } while (0)
  *at_start = 0;
  if (r->growing && end > start) {
    const double near = same_time(interval, start);
    int here = 0, point = 0;
    for (int i = 0; i < r->y_count; i++) {
      if (fabs(r->y_t[i] - start) <= near && speaks(a, i, 0)) here = 1;
      if (!point) point = speaks(a, i, 1);
    }
    *at_start = here && point;
  }
  if (*at_start) EDGE(start);
  EDGE(start);
  double cell = floor(start / interval), before = -HUGE_VAL;
  const double low = start + tolerance, high = end - tolerance;
  int i = 0, j = 0;
  for (int s = 0; s < NY(a->s); s++) {
    a->cursor[s] = HUGE_VAL;
    a->row[s] = 0;
    if (e->held[s])
      do next_expiry(a, s);
      while (a->cursor[s] <= low);
  }
  while (i < r->y_count && !(r->y_t[i] > low && speaks(a, i, 0))) i++;
  while (j < r->u_count && !(r->u_t[j] > low)) j++;
  for (;;) { /* merge cells, samples, input switches and expiries */
    const double corner = cell * interval;
    const double sample = i < r->y_count ? r->y_t[i] : HUGE_VAL, input = j < r->u_count ? r->u_t[j] : HUGE_VAL;
    double next = corner < sample ? corner : sample;
    int from = -1;
    if (input < next) next = input;
    for (int s = 0; s < NY(a->s); s++)
      if (a->cursor[s] < next) next = a->cursor[s], from = s;
    if (!(next < high)) break;
    if (next > low) {
      if (before == -HUGE_VAL || next - before > tolerance) EDGE(next);
      before = next;
    }
    if (from >= 0) {
      next_expiry(a, from);
    } else if (next == corner) {
      cell += 1.0;
    } else if (next == sample) {
      do i++;
      while (i < r->y_count && !speaks(a, i, 0));
    } else {
      j++;
    }
  }
  EDGE(end);
#undef EDGE
  return filled - 1;
}

/* Edges of a discrete model's window: its steps. Returns -1 for times that are none. */
static int mesh_steps(assembly *a) {
  const ctmhe_estimator *e = a->e;
  const ctmhe_request *r = a->r;
  const double step = e->interval, first = rint(r->start / step), last = rint(r->end / step);
  const double relative = 1e-6 * step, absolute = same_time(step, r->end);
  a->tolerance = relative > absolute ? relative : absolute;
  if (fabs(r->start - first * step) > a->tolerance || fabs(r->end - last * step) > a->tolerance) return -1;
  if (!(last - first < (double)r->capacity)) return last - first < 1e8 ? (int)(last - first) + 1 : -1;
  int n = (int)(last - first);
  for (int i = 0; i <= n; i++) a->edge[i] = (first + i) * step;
  if (e->end_slot || n == 0) {
    n++;
    a->edge[n] = a->edge[n - 1];
  }
  return n;
}

static int build_mesh(assembly *a) {
  const ctmhe_estimator *e = a->e;
  int at_start = 0;
  a->tolerance = same_time(e->interval, a->r->end);
  const int n = e->discrete ? mesh_steps(a) : mesh_edges(a, &at_start);
  if (n < 0 || n > a->r->capacity) return n;
  int64_t cell = 0;
  for (int i = n - 1; i >= 0; i--) {
    a->h[i] = a->edge[i + 1] - a->edge[i];
    a->steps[i] = steps_of(a->s, a->h[i]);
    const double at = (a->edge[i] + 0.5 * a->h[i]) / e->interval + 1e-9;
    const int64_t here = (int64_t)at - (at < (double)(int64_t)at); /* floor */
    a->shared[i] = (uint8_t)(!e->discrete && i + 1 < n && here == cell);
    cell = here;
  }
  if (at_start) a->shared[0] = 1;
  return n;
}

/* ---- Weights and data --------------------------------------------------------------------------------------- */

static void known_inputs(const assembly *a, double *u0, double *u1) {
  const ctmhe_request *r = a->r;
  const int nu = a->s->nu, last = r->u_count - 1;
  int i = 0;
  for (int k = 0; k < a->n; k++) {
    const double start = a->edge[k], end = a->edge[k + 1];
    while (i < last && r->u_t[i + 1] <= start + a->tolerance) i++;
    const double *here = r->u + (size_t)i * (size_t)nu;
    if (!a->e->input_linear) {
      for (int l = 0; l < nu; l++) u0[k * nu + l] = u1[k * nu + l] = here[l];
      continue;
    }
    const int j = i < last ? i + 1 : last;
    const double span = r->u_t[j] > r->u_t[i] ? r->u_t[j] - r->u_t[i] : 1.0;
    double since = start - r->u_t[i], until = end - r->u_t[i];
    since = since < 0.0 ? 0.0 : since > span ? span : since;
    until = until < 0.0 ? 0.0 : until > span ? span : until;
    for (int l = 0; l < nu; l++) {
      const double slope = (r->u[(size_t)j * (size_t)nu + (size_t)l] - here[l]) / span;
      u0[k * nu + l] = here[l] + slope * since;
      u1[k * nu + l] = here[l] + slope * until;
    }
  }
}

/* 1 - exp(-z), accurate for small z too. */
static double grown(double z) {
  if (z > 0.02) return -expm1(-z);
  const double a = 1.0 / 6, b = 1.0 / 24, c = 1.0 / 120, d = 1.0 / 720;
  return z * (1.0 - z * (0.5 - z * (a - z * (b - z * (c - z * d)))));
}

/* The share of a discrete model's step k in the discounted sum. */
static double step_weight(const assembly *a, int k) {
  const ctmhe_estimator *e = a->e;
  const int idle = a->n > 0 && a->h[a->n - 1] == 0.0, steps = a->n - idle;
  if (!e->filtering && k >= steps) return 0.0;
  return exp(-e->rate * e->interval * (steps - 1 + e->filtering - k));
}

static void disturbance_weights(assembly *a) {
  const ctmhe_estimator *e = a->e;
  const int nw = NW(a->s);
  const double length = e->rate < 1e-200 ? 0.0 : 1.0 / e->rate;
  for (int k = 0; k < a->n && nw; k++) {
    const double h = a->h[k];
    const double weight = e->discrete     ? step_weight(a, k)
                          : length == 0.0 ? h
                                          : exp(-e->rate * (a->r->end - a->edge[k] - h)) * grown(e->rate * h) * length;
    const double root = sqrt(weight);
    double *L = a->L_w + (size_t)k * (size_t)(nw * nw);
    for (int i = 0; i < nw * nw; i++) L[i] = root * e->root_Q[i];
  }
}

/* L = factor times the root of a weight on the sensors that are known. Returns nonzero where Python has to. */
static int weigh(const assembly *a, double *L, const double *root, int diagonal, const uint8_t *known, double factor) {
  const int ny = NY(a->s);
  int some = 0, all = 1;
  for (int i = 0; i < ny; i++) known[i] ? (some = 1) : (all = 0);
  for (int i = 0; i < ny * ny; i++) L[i] = all ? factor * root[i] : 0.0;
  if (all || !some) return 0;
  if (!diagonal) return 1;
  for (int i = 0; i < ny; i++)
    if (known[i]) L[i * (ny + 1)] = factor * root[i * (ny + 1)];
  return 0;
}

/* The signal of one held sensor, rebuilt on all slots; `known` is marked where there is one. */
static void held_signal(assembly *a, int sensor) {
  const ctmhe_estimator *e = a->e;
  const ctmhe_request *r = a->r;
  const int ny = NY(a->s), q = NQ(a->s), inner = POINTS(a->s) - 1;
  int i = -1, next = 0; /* rows of the sample that holds, and of the one after it */
  while (next < r->y_count && r->y[next * ny + sensor] != r->y[next * ny + sensor]) next++;
  for (int k = 0; k < a->n; k++) {
    const double start = a->edge[k], end = a->edge[k + 1];
    while (next < r->y_count && r->y_t[next] <= start + a->tolerance) {
      i = next++;
      while (next < r->y_count && r->y[next * ny + sensor] != r->y[next * ny + sensor]) next++;
    }
    if (i < 0 || !((start + end) / 2 - r->y_t[i] <= e->hold_limit)) continue;
    const double value = r->y[i * ny + sensor];
    double slope = 0.0;
    if (e->linear[sensor] && next < r->y_count && r->y_t[next] > r->y_t[i])
      slope = (r->y[next * ny + sensor] - value) / (r->y_t[next] - r->y_t[i]);
    double *data = a->y_data + (size_t)(k * q * ny + sensor);
    const double length = a->h[k] / a->steps[k];
    for (int node = 0; node < q; node++) {
      const int used = node < a->steps[k] * inner;
      const double t = used ? start + (node / inner + e->nodes[node % inner]) * length : end;
      data[node * ny] = value + slope * (t - r->y_t[i]);
    }
    a->known[k * ny + sensor] = 1;
  }
}

/* Call `take` for the edge that each row of measurements lies on: index of the row and of the edge. */
#define FOR_ROWS_ON_EDGES(edges)                                                                       \
  for (int row = 0, edge = 0; row < a->r->y_count; row++)                                              \
    for (int met = ((edge = nearest_edge(a, edge, (edges), a->r->y_t[row])),                           \
                    fabs(a->edge[edge] - a->r->y_t[row]) <= a->tolerance);                             \
         met; met = 0)

static int nearest_edge(const assembly *a, int from, int count, double t) {
  int i = from > 0 ? from - 1 : 0;
  while (i < count - 1 && a->edge[i] < t) i++;
  while (i > 0 && a->edge[i - 1] >= t) i--; /* the first of equal edges */
  if (i > 0 && fabs(a->edge[i - 1] - t) < fabs(a->edge[i] - t)) i--;
  return i;
}

static int outputs(assembly *a) {
  const ctmhe_estimator *e = a->e;
  const ctmhe_request *r = a->r;
  const int n = a->n, ny = NY(a->s), q = NQ(a->s), inner = POINTS(a->s) - 1;
  for (int i = 0; i < n * q * ny; i++) a->y_data[i] = 0.0;
  for (int i = 0; i < n * ny; i++) a->count[i] = 0.0, a->known[i] = 0;
  for (int s = 0; s < ny; s++)
    if (e->held[s]) held_signal(a, s);
  for (int k = 0; k < n; k++) {
    const double length = a->h[k] / a->steps[k];
    double *L = a->L_y + (size_t)(k * q * ny * ny);
    for (int node = 0; node < q - 1; node++, L += ny * ny) {
      const int used = node < a->steps[k] * inner;
      const double t = a->edge[k] + (node / inner + e->nodes[node % inner]) * length;
      const double factor = used ? sqrt(length * e->shares[node % inner] * exp(-e->rate * (r->end - t))) : 0.0;
      if (weigh(a, L, e->root_R, e->diagonal_R, a->known + k * ny, factor)) return 1;
    }
  }
  FOR_ROWS_ON_EDGES(n + 1) {
    int slot = edge - 1;
    if (a->h[0] == 0.0 && slot < 0) slot = 0; /* a sample at the window's start has a slot of no length */
    if (slot < 0) continue;
    for (int s = 0; s < ny; s++) {
      const double y = r->y[row * ny + s];
      if (y != y) continue;
      double *data = a->y_data + (size_t)((slot * q + q - 1) * ny + s);
      if (!e->held[s]) {
        *data += y;
        a->count[slot * ny + s] += 1.0;
        a->known[slot * ny + s] = 1;
      } else if (slot == n - 1) { /* a held sensor that speaks at the window's end */
        *data = y;
        a->known[slot * ny + s] = 1;
      }
    }
  }
  for (int k = 0; k < n; k++) {
    double *L = a->L_y + (size_t)((k * q + q - 1) * ny * ny), *count = a->count + k * ny;
    double *data = a->y_data + (size_t)((k * q + q - 1) * ny);
    uint8_t *point = (uint8_t *)a->row;
    int any = 0;
    for (int s = 0; s < ny; s++) {
      point[s] = count[s] > 0.0;
      if (!point[s]) continue;
      any = 1;
      data[s] /= count[s];
    }
    if (!any) {
      memset(L, 0, sizeof(double) * (size_t)(ny * ny));
      continue;
    }
    const double factor = sqrt(exp(-e->rate * (r->end - a->edge[k + 1])));
    if (weigh(a, L, e->root_point, e->diagonal_point, point, factor)) return 1;
    for (int s = 0; s < ny; s++)
      if (count[s] > 1.0)
        for (int i = 0; i < ny; i++) L[i * ny + s] *= sqrt(count[s]);
  }
  return 0;
}

static int outputs_at_steps(assembly *a) {
  const ctmhe_estimator *e = a->e;
  const int n = a->n, ny = NY(a->s);
  for (int i = 0; i < n * ny; i++) a->y_data[i] = 0.0, a->known[i] = 0;
  FOR_ROWS_ON_EDGES(n) {
    for (int s = 0; s < ny; s++) {
      const double y = a->r->y[row * ny + s];
      if (y != y) continue;
      a->y_data[edge * ny + s] = y;
      a->known[edge * ny + s] = 1;
    }
  }
  for (int k = 0; k < n; k++)
    if (weigh(a, a->L_y + (size_t)(k * ny * ny), e->root_R, e->diagonal_R, a->known + k * ny, sqrt(step_weight(a, k))))
      return 1;
  return 0;
}

/* The terminal weight (diagonal) joins that of the last output. */
static void terminal_weight(assembly *a) {
  const ctmhe_estimator *e = a->e;
  const int n = a->n, ny = NY(a->s);
  if (!e->root_S || (e->discrete && a->h[n - 1] != 0.0)) return;
  double *L = a->L_y + (size_t)((n * NQ(a->s) - 1) * ny * ny);
  for (int i = 0; i < ny; i++)
    if (a->known[(n - 1) * ny + i]) {
      const double one = L[i * (ny + 1)], other = e->root_S[i * (ny + 1)];
      L[i * (ny + 1)] = sqrt(one * one + other * other);
    }
}

/* Boxes on every slot; returns whether any bound of an output is finite. */
static int bounds(assembly *a) {
  const ctmhe_estimator *e = a->e;
  const int n = a->n, nx = NX(a->s), nw = NW(a->s), ny = NY(a->s), q = NQ(a->s);
  int finite = 0;
  for (int k = 0; k <= n; k++)
    for (int i = 0; i < nx; i++) a->x_lower[k * nx + i] = e->x_lower[i], a->x_upper[k * nx + i] = e->x_upper[i];
  for (int k = 0; k < n; k++) {
    const int idle = a->h[k] == 0.0 && !a->shared[k] && !(e->discrete && e->filtering);
    for (int i = 0; i < nw; i++) {
      a->w_lower[k * nw + i] = idle ? 0.0 : e->w_lower[i];
      a->w_upper[k * nw + i] = idle ? 0.0 : e->w_upper[i];
    }
    for (int i = 0; i < ny; i++) {
      double low = e->y_lower[i], high = e->y_upper[i];
      if (a->known[k * ny + i]) { /* residual = y - y_hat */
        const double y = a->y_data[(k * q + q - 1) * ny + i];
        if (y - e->residual_upper[i] > low) low = y - e->residual_upper[i];
        if (y - e->residual_lower[i] < high) high = y - e->residual_lower[i];
      }
      a->y_lower[k * ny + i] = low;
      a->y_upper[k * ny + i] = high;
      finite |= low > -HUGE_VAL || high < HUGE_VAL;
    }
  }
  return finite;
}

/* ---- Prior and guess ---------------------------------------------------------------------------------------- */

/* One slot of the model without derivatives; x_next into `x`. Returns nonzero where that is not finite. */
static int carry(const assembly *a, double t, double h, const double *from, const double *w, const double *p,
                 const double *u0, const double *u1, double *x) {
  double *y = a->work, *next = y + NQ(a->s) * NY(a->s), finite = 0.0;
  const slot_call c = {t, h, from, w, p, u0, u1, next, y, NULL};
  if (evaluate_slots(a->s, &a->s->value, &c, 1, next + NX(a->s))) return 1;
  for (int i = 0; i < NX(a->s); i++) {
    finite += next[i] * 0.0;
    x[i] = next[i];
  }
  return finite != 0.0;
}

/* A row of the path: start of the slot, from when on the row counts, x, w, u0, u1, p, x at its end. See priors.py. */
static size_t path_width(const assembly *a) { return (size_t)(2 + 2 * NX(a->s) + NW(a->s) + 2 * a->s->nu + NP(a->s)); }

/* x_hat(t) and p_hat(t) of the estimated trajectory (3.18). Returns nonzero where that is not kept. */
static int filtering_prior(const assembly *a, double *prior) {
  const ctmhe_request *r = a->r;
  const double slack = same_time(a->e->interval, r->last_end);
  double t = r->start < r->last_end ? r->start : r->last_end;
  if (r->start > r->last_end + slack || !r->path_count || t > r->path_t[r->path_count - 1] + slack) return 1;
  int low = 0, high = r->path_count - 1;
  while (low < high) {
    const int middle = low + (high - low) / 2;
    if (r->path_t[middle] >= t - slack) high = middle;
    else low = middle + 1;
  }
  const double end = r->path_t[low], *row = r->path + (size_t)low * path_width(a), start = row[0];
  const double *x = row + 2, *w = x + NX(a->s), *u0 = w + NW(a->s), *u1 = u0 + a->s->nu, *p = u1 + a->s->nu, *x_end = p + NP(a->s);
  if (t <= row[1] + slack) return 1;
  if (t > end) t = end;
  for (int i = 0; i < NP(a->s); i++) prior[NX(a->s) + i] = p[i];
  if (t == end || t <= start) {
    for (int i = 0; i < NX(a->s); i++) prior[i] = t == end ? x_end[i] : x[i];
    return 0;
  }
  double *u = a->input;
  for (int i = 0; i < a->s->nu; i++) u[i] = u0[i] + (u1[i] - u0[i]) * ((t - start) / (end - start));
  return carry(a, start, t - start, x, w, p, u0, u, prior);
}

static int all_finite(const double *x, int count) {
  double finite = 0.0;
  for (int i = 0; i < count; i++) finite += x[i] * 0.0;
  return finite == 0.0;
}

/* The prior carried forward without disturbance, held where the model leaves its domain. */
static void shifted_guess(const assembly *a, const ctmhe_window *win, ctmhe_result *g) {
  const int nx = NX(a->s), nw = NW(a->s), n = a->n;
  int good = 1;
  for (int i = 0; i < nx; i++) {
    const double x = win->prior[i], low = win->x_lower[i], high = win->x_upper[i];
    g->x[i] = x < low ? low : x > high ? high : x;
  }
  for (int i = 0; i < n * nw; i++) g->w[i] = 0.0;
  for (int i = 0; i < NP(a->s); i++) g->p[i] = win->prior[nx + i];
  for (int k = 0; k < n && good; k++)
    good = !carry(a, a->edge[k], a->h[k], g->x + k * nx, g->w + k * nw, g->p, win->u0 + k * a->s->nu,
                  win->u1 + k * a->s->nu, g->x + (k + 1) * nx);
  for (int k = 1; k <= n && !good; k++)
    for (int i = 0; i < nx; i++) g->x[k * nx + i] = g->x[i];
  memset(g->x_active, 0, (size_t)((n + 1) * nx));
  memset(g->w_active, 0, (size_t)(n * nw));
  memset(g->y_active, 0, (size_t)(n * NY(a->s)));
  memset(g->p_active, 0, (size_t)NP(a->s));
}

/* The last solution on the new mesh, carried forward behind its end, with its active set. */
static void warm_start(const assembly *a, const ctmhe_window *win, ctmhe_result *g) {
  const ctmhe_request *r = a->r;
  const int nx = NX(a->s), nw = NW(a->s), ny = NY(a->s), n = a->n, m = r->last_n;
  const double *last_t = r->last, *last_x = last_t + m + 1, *last_w = last_x + (size_t)((m + 1) * nx);
  const int8_t *x_active = r->last_active, *w_active = x_active + (m + 1) * nx, *y_active = w_active + m * nw,
               *p_active = y_active + m * ny;
  const double end = last_t[m];
  int old = 0; /* nodes that the last window covers */
  for (int k = 0, j = 0; k <= n; k++) {
    const double t = a->edge[k];
    if (t > end) break;
    old = k + 1;
    while (j < m && last_t[j + 1] <= t) j++;
    const double *left = last_x + (size_t)j * (size_t)nx, length = j < m ? last_t[j + 1] - last_t[j] : 0.0;
    const double share = length > 0.0 && t > last_t[j] ? (t - last_t[j]) / length : 0.0;
    for (int i = 0; i < nx; i++) g->x[k * nx + i] = share > 0.0 ? left[i] + share * (left[nx + i] - left[i]) : left[i];
  }
  for (int k = 0, j = 0; k < n; k++) {
    const double middle = a->edge[k] + a->h[k] / 2;
    while (j < m - 1 && last_t[j + 1] <= middle) j++;
    const int inside = middle >= last_t[0] && middle <= end;
    for (int i = 0; i < nw; i++) {
      g->w[k * nw + i] = inside ? last_w[j * nw + i] : 0.0;
      g->w_active[k * nw + i] = inside ? w_active[j * nw + i] : 0;
    }
    for (int i = 0; i < ny; i++) g->y_active[k * ny + i] = inside ? y_active[j * ny + i] : 0;
  }
  for (int k = 0; k + 1 < n; k++)
    for (int i = 0; a->shared[k] && i < nw; i++) g->w[(k + 1) * nw + i] = g->w[k * nw + i];
  for (int k = 0, j = 0; k <= n; k++) {
    while (j < m && last_t[j] < a->edge[k] - a->tolerance) j++;
    const int covered = a->edge[k] <= end + a->tolerance;
    for (int i = 0; i < nx; i++) g->x_active[k * nx + i] = covered ? x_active[j * nx + i] : 0;
  }
  for (int i = 0; i < NP(a->s); i++) {
    g->p[i] = a->e->p_estimated ? r->p[i] : win->prior[nx + i];
    g->p_active[i] = p_active[i];
  }
  for (int k = old > 0 ? old - 1 : 0; k < n; k++)
    if (carry(a, a->edge[k], a->h[k], g->x + k * nx, g->w + k * nw, g->p, win->u0 + k * a->s->nu, win->u1 + k * a->s->nu,
              g->x + (k + 1) * nx)) {
      shifted_guess(a, win, g);
      return;
    }
  if (!all_finite(g->x, (n + 1) * nx)) shifted_guess(a, win, g);
}

/* ---- The update --------------------------------------------------------------------------------------------- */

/* Where the arrays of a window of n slots lie in the caller's two blocks, in the order of solved.py. */
static void lay_out_result(const assembly *a, ctmhe_window *win, ctmhe_result *g) {
  const ctmhe_request *r = a->r;
  const size_t n = (size_t)a->n, nx = (size_t)NX(a->s), nw = (size_t)NW(a->s), np = (size_t)NP(a->s), nu = (size_t)a->s->nu;
  const size_t ny = (size_t)NY(a->s), q = (size_t)NQ(a->s);
  double *at = r->values;
  int8_t *flag = r->active;
#define PLACE(field, count) (field = at, at += (count))
#define FLAG(field, count) (field = flag, flag += (count))
  memcpy(at, a->edge, sizeof(double) * (n + 1));
  win->t = at, at += n + 1;
  PLACE(g->x, (n + 1) * nx);
  PLACE(g->w, n * nw);
  PLACE(g->y, n * q * ny);
  win->u0 = at, at += n * nu;
  win->u1 = at, at += n * nu;
  PLACE(g->p, np);
  win->prior = at, at += nx + np;
  PLACE(g->dynamics_multiplier, n * nx);
  PLACE(g->x_multiplier, (n + 1) * nx);
  PLACE(g->w_multiplier, n * nw);
  PLACE(g->y_multiplier, n * ny);
  PLACE(g->p_multiplier, np);
  FLAG(g->x_active, (n + 1) * nx);
  FLAG(g->w_active, n * nw);
  FLAG(g->y_active, n * ny);
  FLAG(g->p_active, np);
#undef PLACE
#undef FLAG
}

static int assemble(assembly *a, const ctmhe_stage *stage, const ctmhe_estimator *e, ctmhe_request *r, ctmhe_window *win,
                    ctmhe_result *g, char *scratch) {
  a->s = stage, a->e = e, a->r = r;
  lay_out_assembly(a, scratch, stage, r->capacity);
  if (a->s->nu && (!r->u_count || r->u_t[0] > r->start + same_time(e->interval, r->start))) return CTMHE_ELSEWHERE;
  r->n = a->n = build_mesh(a);
  if (a->n < 1) return CTMHE_ELSEWHERE;
  if (a->n > r->capacity) return CTMHE_TOO_SMALL;
  lay_out_result(a, win, g);
  double *prior = (double *)win->prior;
  if (r->anchored) memcpy(prior, r->prior, sizeof(double) * (size_t)(NX(a->s) + NP(a->s)));
  else if (filtering_prior(a, prior)) return CTMHE_ELSEWHERE;
  known_inputs(a, (double *)win->u0, (double *)win->u1);
  disturbance_weights(a);
  if (e->discrete ? outputs_at_steps(a) : outputs(a)) return CTMHE_ELSEWHERE;
  terminal_weight(a);
  const int width = NX(a->s) + (e->p_estimated ? NP(a->s) : 0);
  const double factor = r->root_prior ? 1.0 : sqrt(exp(-e->prior_rate * (r->end - r->start)));
  const double *root = r->root_prior ? r->root_prior : e->root_P;
  for (int i = 0; i < width * width; i++) a->L_prior[i] = factor * root[i];
  win->n = a->n;
  win->p_estimated = e->p_estimated;
  win->output_bounded = bounds(a);
  win->h = a->h, win->shared = a->shared;
  win->L_prior = a->L_prior, win->L_w = a->L_w, win->L_y = a->L_y, win->y_data = a->y_data;
  win->x_lower = a->x_lower, win->x_upper = a->x_upper, win->w_lower = a->w_lower, win->w_upper = a->w_upper;
  win->y_lower = a->y_lower, win->y_upper = a->y_upper, win->p_lower = e->p_lower, win->p_upper = e->p_upper;
  win->x_scale = e->x_scale, win->w_scale = e->w_scale, win->p_scale = e->p_scale, win->y_scale = e->y_scale;
  r->measured = 0;
  for (int i = 0; i < a->n * NQ(a->s) * NY(a->s) * NY(a->s) && !r->measured; i++) r->measured = a->L_y[i] != 0.0;
  if (r->last && r->last[r->last_n] >= r->start) warm_start(a, win, g);
  else shifted_guess(a, win, g);
  return 0;
}

/* The rows that this solution adds to the path: its slots behind `since`. */
static void write_path(const assembly *a, const ctmhe_window *win, const ctmhe_result *g, ctmhe_request *r) {
  const int nx = NX(a->s), nw = NW(a->s), nu = a->s->nu, n = a->n;
  int first = 0;
  while (first < n - 1 && a->edge[first + 1] <= r->since) first++;
  r->path_added = 0;
  for (int k = first; k < n; k++) {
    if (a->h[k] == 0.0) continue;
    double *row = r->path_rows + (size_t)r->path_added * path_width(a);
    r->path_times[r->path_added++] = a->edge[k + 1];
    *row++ = a->edge[k];
    *row++ = a->edge[k] > r->since ? a->edge[k] : r->since;
    for (int i = 0; i < nx; i++) *row++ = g->x[k * nx + i];
    for (int i = 0; i < nw; i++) *row++ = g->w[k * nw + i];
    for (int i = 0; i < nu; i++) *row++ = win->u0[k * nu + i];
    for (int i = 0; i < nu; i++) *row++ = win->u1[k * nu + i];
    for (int i = 0; i < NP(a->s); i++) *row++ = g->p[i];
    for (int i = 0; i < nx; i++) *row++ = g->x[(k + 1) * nx + i];
  }
}

#endif
