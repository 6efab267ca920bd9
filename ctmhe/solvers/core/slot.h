/* The model over one slot: its integration steps one after the other, and the chain rule through them. Functions on a
 * tape take several slots at once. */
#ifndef CTMHE_SLOT_H
#define CTMHE_SLOT_H

#include "own.h"

/* Evaluate a function of one step for some slots at once. Returns nonzero on failure. */
static int call_step(const ctmhe_stage *s, const ctmhe_function *f, const call *calls, int lanes, int results) {
  if (f->batch) return f->batch(calls, lanes);
  if (f->tape) return run_tape(f, calls, lanes);
  if (f->function) {
    const double *given[CTMHE_MAX_ARGUMENTS];
    double *taken[CTMHE_MAX_ARGUMENTS];
    for (int l = 0; l < lanes; l++) {
      memcpy(given, calls[l].arg, sizeof calls[l].arg);
      memcpy(taken, calls[l].res, sizeof(double *) * (size_t)results);
      if (f->function(given, taken, f->iw, f->w, 0)) return 1;
    }
    return 0;
  }
  if (f->evaluate) {
    for (int l = 0; l < lanes; l++)
      if (own_step(s, f, calls + l, results == 3)) return 1;
    return 0;
  }
  const int nx = NX(s), nw = NW(s), np = NP(s), nu = s->nu, outputs = POINTS(s) * NY(s), n0 = nx + nw + np;
  const int given[9] = {1, 1, nx, nw, np, nu, nu, nx, outputs}, curvature = results == 1;
  const int taken[3] = {curvature ? n0 * n0 : nx, outputs, (nx + outputs) * n0};
  for (int l = 0; l < lanes; l++) {
    for (int j = 0; j < (curvature ? 9 : 7); j++)
      for (int i = 0; i < given[j]; i++) f->arg[j][i] = calls[l].arg[j][i];
    f->eval(f->self);
    if (f->failed && *f->failed) return 1;
    for (int j = 0; j < results; j++)
      for (int i = 0; i < taken[j]; i++) calls[l].res[j][i] = f->res[j][i];
  }
  return 0;
}

/* Integration steps of a slot of h seconds. */
static int steps_of(const ctmhe_stage *s, double h) {
  if (s->steps == 1) return 1;
  const double needed = ceil(h / s->step_length * (1.0 - 1e-9));
  return needed < 1.0 ? 1 : needed > s->steps ? s->steps : (int)needed;
}

/* Work of one lane: u0 and u1 of a step, its results, and the state that it starts from. */
typedef struct {
  double *u0, *u1, *x_next, *y, *J, *x;
} workspace;

static workspace work_of(const ctmhe_stage *s, double *memory) {
  workspace k;
  k.u0 = memory;
  k.u1 = k.u0 + s->nu;
  k.x = k.u1 + s->nu;
  k.x_next = k.x + NX(s);
  k.y = k.x_next + NX(s);
  k.J = k.y + POINTS(s) * NY(s);
  return k;
}

/* A slot's arguments, and where its results go: x_next (nx), y (q ny), J (nx + q ny rows, nx + nw + np columns, column-
 * major), or NULL. */
typedef struct {
  double t, h;
  const double *x, *w, *p, *u0, *u1;
  double *x_next, *y, *J;
} slot_call;

/* The call of step i of a slot. */
static void set_step(const ctmhe_stage *s, const slot_call *c, const workspace *k, call *one, int i, int steps) {
  const double length = c->h / steps, begin = (double)i / steps, end = (double)(i + 1) / steps;
  one->t = c->t + i * length;
  one->inner = i + 1 < steps;
  one->h = length;
  for (int l = 0; l < s->nu; l++) {
    k->u0[l] = c->u0[l] + (c->u1[l] - c->u0[l]) * begin;
    k->u1[l] = c->u0[l] + (c->u1[l] - c->u0[l]) * end;
  }
  one->arg[0] = &one->t, one->arg[1] = &one->h, one->arg[2] = i ? k->x : c->x, one->arg[3] = c->w, one->arg[4] = c->p;
  one->arg[5] = k->u0, one->arg[6] = k->u1, one->arg[7] = one->arg[8] = NULL;
  one->res[0] = k->x_next, one->res[1] = k->y, one->res[2] = k->J;
}

/* Take over the results of step i: x, the outputs at its nodes and, of the last step, at its end; Jacobians by the
 * chain rule. The first nx rows of c->J hold d x / d(x, w, p) at the step's start. */
static void take_step(const ctmhe_stage *s, const slot_call *c, const workspace *k, int i, int last) {
  const int nx = NX(s), ny = NY(s), inner = (POINTS(s) - 1) * ny, n0 = nx + NW(s) + NP(s);
  const int height = nx + NQ(s) * ny, rows = nx + POINTS(s) * ny, at = nx + i * inner, end = height - ny;
  for (int j = 0; j < nx; j++) k->x[j] = k->x_next[j];
  for (int j = 0; j < inner; j++) c->y[i * inner + j] = k->y[j];
  if (last) {
    for (int j = 0; j < nx; j++) c->x_next[j] = k->x_next[j];
    for (int j = 0; j < ny; j++) c->y[end - nx + j] = k->y[inner + j];
  }
  if (!c->J) return;
  const int used = last ? rows : nx + inner;
  double *sum = k->x_next; /* and the outputs behind it: they have been taken over */
  for (int column = 0; column < n0; column++) {
    double *target = c->J + column * height;
    const double *own = k->J + column * rows;
    if (i == 0) {
      for (int j = 0; j < used; j++) sum[j] = own[j];
    } else {
      for (int j = 0; j < used; j++) sum[j] = column < nx ? 0.0 : own[j];
      for (int l = 0; l < nx; l++) {
        const double a = target[l];
        if (a == 0.0) continue;
        const double *source = k->J + l * rows;
        for (int j = 0; j < used; j++) sum[j] += a * source[j];
      }
    }
    for (int j = 0; j < nx; j++) target[j] = sum[j];
    for (int j = 0; j < inner; j++) target[at + j] = sum[nx + j];
    if (last)
      for (int j = 0; j < ny; j++) target[end + j] = sum[nx + inner + j];
  }
}

/* Evaluate up to BATCH slots; `memory` has step_work_size for each when slots have several steps. Outputs at nodes
 * of steps that a slot does without are zero. Returns nonzero on failure. */
static int evaluate_slots(const ctmhe_stage *s, const ctmhe_function *f, const slot_call *slots, int lanes,
                          double *memory) {
  call calls[BATCH];
  const int derivatives = slots[0].J != NULL, results = derivatives ? 3 : 2;
  if (s->steps == 1) {
    for (int l = 0; l < lanes; l++) {
      const slot_call *c = slots + l;
      const double *arg[9] = {&c->t, &c->h, c->x, c->w, c->p, c->u0, c->u1, NULL, NULL};
      double *res[3] = {c->x_next, c->y, c->J};
      memcpy(calls[l].arg, arg, sizeof arg);
      memcpy(calls[l].res, res, sizeof res);
      calls[l].inner = 0;
    }
    return call_step(s, f, calls, lanes, results);
  }
  const size_t size = step_work_size(s, derivatives);
  int most = 1, steps[BATCH];
  for (int l = 0; l < lanes; l++) {
    steps[l] = steps_of(s, slots[l].h);
    if (steps[l] > most) most = steps[l];
    memset(slots[l].y, 0, sizeof(double) * (size_t)(NQ(s) * NY(s)));
  }
  for (int i = 0; i < most; i++) {
    int live[BATCH], count = 0;
    for (int l = 0; l < lanes; l++) {
      if (i >= steps[l]) continue;
      const workspace k = work_of(s, memory + (size_t)l * size);
      live[count] = l;
      set_step(s, slots + l, &k, calls + count++, i, steps[l]);
    }
    if (call_step(s, f, calls, count, results)) return 1;
    for (int l = 0; l < count; l++) {
      const workspace k = work_of(s, memory + (size_t)live[l] * size);
      take_step(s, slots + live[l], &k, i, i + 1 == steps[live[l]]);
    }
  }
  return 0;
}

/* The second derivatives H (n0, n0) of lambda_x' x_next + lambda_y' vec(y) of a slot, at the head of `memory`. */
static int slot_curvature(const ctmhe_stage *s, const slot_call *c, const double *lambda_x, const double *lambda_y,
                          double *memory) {
  const int nx = NX(s), ny = NY(s), nw = NW(s), np = NP(s), n0 = nx + nw + np, steps = steps_of(s, c->h);
  const int points = POINTS(s), inner = (points - 1) * ny, rows = nx + points * ny;
  double *H = memory;
  if (s->steps == 1) {
    const call one = {{&c->t, &c->h, c->x, c->w, c->p, c->u0, c->u1, lambda_x, lambda_y}, {H, NULL, NULL}, 0.0, 0.0, 0};
    return call_step(s, &s->curvature, &one, 1, 1);
  }
  double *dual_x = H + n0 * n0, *dual_y = dual_x + nx, *step_H = dual_y + points * ny, *T = step_H + n0 * n0,
         *product = T + n0 * n0, *chain = product + n0 * n0;
  const size_t each = step_work_size(s, 1), stride = each + (size_t)(nx * n0);
  for (int i = 0; i < steps; i++) { /* forward: each step's start, derivatives, and the start's derivatives */
    const workspace k = work_of(s, chain + (size_t)i * stride);
    double *S = chain + (size_t)i * stride + each;
    call one;
    if (i) {
      const workspace before = work_of(s, chain + (size_t)(i - 1) * stride);
      const double *S0 = chain + (size_t)(i - 1) * stride + each;
      for (int j = 0; j < nx; j++) {
        k.x[j] = before.x_next[j];
        for (int column = 0; column < n0; column++) {
          double sum = column < nx ? 0.0 : before.J[column * rows + j];
          for (int l = 0; l < nx; l++) sum += before.J[l * rows + j] * S0[l * n0 + column];
          S[j * n0 + column] = sum;
        }
      }
    } else {
      for (int j = 0; j < nx; j++)
        for (int column = 0; column < n0; column++) S[j * n0 + column] = j == column;
      for (int j = 0; j < nx; j++) k.x[j] = c->x[j];
    }
    set_step(s, c, &k, &one, i, steps);
    if (call_step(s, &s->jacobian, &one, 1, 3)) return 1;
  }
  for (int j = 0; j < n0 * n0; j++) H[j] = 0.0;
  for (int j = 0; j < nx; j++) dual_x[j] = lambda_x[j];
  for (int i = steps - 1; i >= 0; i--) {
    const workspace k = work_of(s, chain + (size_t)i * stride);
    const double *S = chain + (size_t)i * stride + each;
    call one;
    for (int j = 0; j < inner; j++) dual_y[j] = lambda_y[i * inner + j];
    for (int j = 0; j < ny; j++) dual_y[inner + j] = i == steps - 1 ? lambda_y[(NQ(s) - 1) * ny + j] : 0.0;
    set_step(s, c, &k, &one, i, steps);
    one.arg[7] = dual_x, one.arg[8] = dual_y;
    one.res[0] = step_H;
    if (call_step(s, &s->curvature, &one, 1, 1)) return 1;
    for (int j = 0; j < n0; j++)
      for (int l = 0; l < n0; l++) T[j * n0 + l] = j < nx ? S[j * n0 + l] : j == l;
    for (int j = 0; j < n0; j++)
      for (int l = 0; l < n0; l++) {
        double sum = 0.0;
        for (int r = 0; r < n0; r++) sum += step_H[j + r * n0] * T[r * n0 + l];
        product[j * n0 + l] = sum;
      }
    for (int j = 0; j < n0; j++)
      for (int l = 0; l < n0; l++) {
        double sum = 0.0;
        for (int r = 0; r < n0; r++) sum += T[r * n0 + j] * product[r * n0 + l];
        H[j + l * n0] += sum;
      }
    for (int j = 0; j < nx; j++) {
      double sum = 0.0;
      for (int l = 0; l < nx; l++) sum += k.J[j * rows + l] * dual_x[l];
      for (int l = 0; l < points * ny; l++) sum += k.J[j * rows + nx + l] * dual_y[l];
      product[j] = sum;
    }
    for (int j = 0; j < nx; j++) dual_x[j] = product[j];
  }
  return 0;
}

#endif
