/* Sizes, constants, and where everything lies in the scratch memory. */
#ifndef CTMHE_LAYOUT_H
#define CTMHE_LAYOUT_H

#include "tape.h"

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

#ifdef CTMHE_P /* whether parameters are estimated, where that is known: half as much to compile */
#define ESTIMATED(k) (CTMHE_NP && CTMHE_P)
#else
#define ESTIMATED(k) (NP((k)->s) && (k)->np)
#endif
#define POINTS(s) ((NQ(s) - 1) / (s)->steps + 1) /* output evaluations of one integration step */

/* Work of one slot. Where sizes are constants and small: local arrays, which a compiler keeps in registers. */
#if defined(CTMHE_NX) && CTMHE_NX + CTMHE_NW + CTMHE_NP > 0 && CTMHE_NX + CTMHE_NW + CTMHE_NP <= 8
#define SLOT_SIZE (CTMHE_NX + CTMHE_NW + CTMHE_NP)
#define WORK(name, memory) double name[SLOT_SIZE]
#define SQUARE(name, memory) double name[SLOT_SIZE * SLOT_SIZE]
#else
#define WORK(name, memory) double *restrict name = (memory)
#define SQUARE(name, memory) double *restrict name = (memory)
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
#define ROUGH 1e-9         /* residual of a step above which the plain recursion gives way to the square-root one */
#define STIFFNESS 1e6      /* springs against typical curvature of the states */
#define MAX_CORRECTIONS 12
#define HELD 1e-11         /* accuracy of a held bound, scaled */
#define TILE 4
#define WIDE_FROM 16 /* variables of a slot: the kernels of wide.h */

enum { OK = 0, INDEFINITE = 1, NOT_A_NUMBER = 2, INCONSISTENT = 3 };
enum { ZERO = 0, DIAGONAL = 1, DENSE = 2 };

typedef struct {           /* the problem linearised at a point */
  double *x, *w, *p, *y;
  double *c;               /* (N, nx) scaled defects */
  double *H, *g;           /* (N, n, n) upper triangles, (N, n) */
  double *J;               /* (N, nx + nb, n) scaled dynamics rows, then bounded output rows */
  double *parts;           /* (N, 4) each slot's share of the following, the prior's cost apart */
  double cost, infeasibility, defect, excess;
} model;

typedef struct {           /* the window that the linearisation and the factors in memory belong to */
  int valid, N, np, nb, factorized;
  double *t, *h, *u0, *u1, *prior, *L_prior, *L_w, *L_y, *y_data, *y_lower, *y_upper;
  uint8_t *shared;
} memo;

typedef struct {
  const ctmhe_stage *s;
  const ctmhe_window *win;
  int N, n, np, nb;        /* n = nw + nx + np; np: estimated parameters; nb: bounded outputs */
  int bounded;             /* any finite bound at all */
  size_t nf;               /* flat vectors: x (N+1, nx), w (N, nw), y (N, nb), p (np) */
  size_t fw, fy, fp;       /* where w, y, p start in them */
  double *scale, *inverse_x; /* (n) of v; 1 / x_scale */
  double *factor;          /* (nx, n) what scales the Jacobian of a step: scale / x_scale */
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
  int calm;                /* nothing is held, pushed or damped */
  int relative;            /* `low` and `high` belong to the point */
  int rebuilt;             /* slots behind this one have their factors already; N: none has */
  memo *memo;
  uint8_t *stale;          /* (N) slots whose linearisation is not the one in memory; NULL: all */
  double *before;          /* H and J of a slot before it is linearised again */
  double *lambda;          /* (N, nx) */
  int8_t *active, *candidate, *cautious, *kept;
  uint8_t *fixed;
  double *lane, *steps;    /* results of the slots evaluated at once; work of their steps */
  double *second;          /* second derivatives of one slot, with work */
  model a, b;
  int plain;               /* with second derivatives: keep P = U'U itself, which may be indefinite */
  double stiffness, damping;
  double decrease, curvature, optimality, stationarity; /* of the last step */
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
  m->parts = DOUBLES(memory, 4 * N);
}

static void lay_out_memo(memo *m, arena *memory, const ctmhe_stage *s, size_t N) {
  const size_t nw = (size_t)NW(s), ny = (size_t)NY(s), q = (size_t)NQ(s), width = (size_t)(NX(s) + NP(s));
  memo found = *m;
  found.t = DOUBLES(memory, N + 1);
  found.h = DOUBLES(memory, N);
  found.u0 = DOUBLES(memory, N * (size_t)s->nu);
  found.u1 = DOUBLES(memory, N * (size_t)s->nu);
  found.prior = DOUBLES(memory, width);
  found.L_prior = DOUBLES(memory, width * width);
  found.L_w = DOUBLES(memory, N * nw * nw);
  found.L_y = DOUBLES(memory, N * q * ny * ny);
  found.y_data = DOUBLES(memory, N * q * ny);
  found.y_lower = DOUBLES(memory, N * ny);
  found.y_upper = DOUBLES(memory, N * ny);
  found.shared = take(memory, N);
  if (memory->at) *m = found;
}

/* Slots that a function takes at once. */
static int lanes_of(const ctmhe_function *f) { return f->batch || f->tape ? BATCH : 1; }

/* Doubles of work for one integration step, and for the second derivatives of a slot: see slot.h. */
static size_t step_work_size(const ctmhe_stage *s, int derivatives) {
  const size_t nx = (size_t)NX(s), outputs = (size_t)(POINTS(s) * NY(s)), n0 = nx + (size_t)(NW(s) + NP(s));
  return 2 * (size_t)s->nu + 2 * nx + outputs + (derivatives ? (nx + outputs) * n0 : 0);
}

static size_t curvature_work_size(const ctmhe_stage *s) {
  const size_t n0 = (size_t)(NX(s) + NW(s) + NP(s)), nx = (size_t)NX(s), steps = (size_t)s->steps;
  const size_t outputs = (size_t)(POINTS(s) * NY(s)), each = step_work_size(s, 1);
  return n0 * n0 + nx + outputs + (steps > 1 ? steps * (each + nx * n0) + 3 * n0 * n0 : 0);
}

static size_t lay_out(core *k, char *scratch, const ctmhe_stage *s, int slots, int np, int nb) {
  const size_t N = (size_t)slots, nx = (size_t)NX(s), nw = (size_t)NW(s), ny = (size_t)NY(s), q = (size_t)NQ(s);
  const size_t all = (size_t)NP(s), n = nw + nx + (size_t)np, qy = q * ny, n0 = nx + nw + all;
  arena memory = {scratch, 0};
  memo none = {0};
  k->memo = take(&memory, sizeof(memo)); /* first: found again whatever the sizes of the next window */
  k->fw = (N + 1) * nx;
  k->fy = k->fw + N * nw;
  k->fp = k->fy + N * (size_t)nb;
  k->nf = k->fp + (size_t)np;
  k->scale = DOUBLES(&memory, n);
  k->inverse_x = DOUBLES(&memory, nx);
  k->factor = DOUBLES(&memory, nx * n);
  k->inverse = DOUBLES(&memory, nx + nw + (size_t)nb + (size_t)np);
  k->W = DOUBLES(&memory, N * nw * nw);
  k->P = DOUBLES(&memory, (nx + (size_t)np) * (nx + (size_t)np));
  k->rows = DOUBLES(&memory, qy * n + 1);
  k->residual = DOUBLES(&memory, qy + 1);
  k->S = DOUBLES(&memory, (6 * n + TILE) * n);
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
  const size_t lanes = (size_t)(lanes_of(&s->value) > 1 ? lanes_of(&s->value) : lanes_of(&s->jacobian));
  k->lane = DOUBLES(&memory, lanes * (nx + qy + (nx + qy) * n0));
  k->steps = DOUBLES(&memory, s->steps > 1 ? lanes * step_work_size(s, 1) : 0);
  k->second = DOUBLES(&memory, curvature_work_size(s));
  lay_out_model(&k->a, &memory, N, nx, nw, all, qy, n, (size_t)nb);
  lay_out_model(&k->b, &memory, N, nx, nw, all, qy, n, (size_t)nb);
  k->before = DOUBLES(&memory, n * n + (nx + (size_t)nb) * n);
  k->stale = take(&memory, N);
  k->kind_w = take(&memory, N);
  k->kind_y = take(&memory, N * q + 1);
  k->fixed = take(&memory, k->nf);
  k->active = take(&memory, k->nf);
  k->candidate = take(&memory, k->nf);
  k->cautious = take(&memory, k->nf);
  k->kept = take(&memory, k->nf);
  lay_out_memo(scratch ? k->memo : &none, &memory, s, N);
  return memory.used;
}

static void copy(double *to, const double *from, size_t count) {
  if (count) memcpy(to, from, sizeof(double) * count);
}

#endif
