/* The structured Gauss-Newton core: one window's problem as plain arrays, solved without a call back into Python.
 *
 * All arrays are C-ordered doubles (int8 for active sets, uint8 for flags), laid out as the attributes of
 * `ctmhe.transcription.problem.Window` and `Guess` with the same names. The core keeps no state between calls: equal
 * arguments give equal results. Scratch memory is a block that the caller owns, one a thread.
 *
 * Sizes are run-time values in the shipped build. Compiled together with a model's stage function, they are constants:
 * define CTMHE_NX, CTMHE_NW, CTMHE_NP, CTMHE_NY, CTMHE_NQ before including core.c.
 */
#ifndef CTMHE_CORE_H
#define CTMHE_CORE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define CTMHE_CORE_VERSION 9
#define CTMHE_BATCH 8          /* slots that a tape is run for at once */
#define CTMHE_MAX_ARGUMENTS 64 /* pointers a compiled stage function may use (CasADi's sz_arg, sz_res) */

/* The stage function over one integration step, in CasADi's own calling convention, with y at r points of the step:
 * arguments t, h, x (nx), w (nw), p (np), u0 (nu), u1 (nu) [, lambda_x (nx), lambda_y (r*ny)]
 * results of `jacobian`: x_next (nx), y (r*ny), J (nx + r*ny rows, nx + nw + np columns, column-major)
 * results of `value`: x_next, y;  of `curvature`: H (n x n, n = nx + nw + np)
 * A slot is covered by as few equal steps as its length needs; its outputs are those at the first r - 1 points of each
 * step and at its end, q = steps (r - 1) + 1. */
typedef int (*ctmhe_casadi)(const double **arg, double **res, long long *iw, double *w, int mem);

/* CasADi's evaluation buffer (the VM): eval(self) reads and writes memory bound beforehand. */
typedef void (*ctmhe_buffer_eval)(void *self);

typedef struct {              /* arguments and results of one step, in that order */
  const double *arg[9];
  double *res[3];
  double t, h;
  int inner;                  /* another step of the slot follows: the output at this one's end is not wanted */
} ctmhe_call;

/* The same for up to CTMHE_BATCH steps at once: what tape.py writes for models of scalar expressions. */
typedef int (*ctmhe_batch)(const ctmhe_call *calls, int lanes);

/* A model that evaluates itself (an FMU): dx (nx), or the state one step later; y (ny); J (nx + ny rows; columns x, w, p;
 * column-major). Any of them may be NULL; the rows of J of what is not asked for are left alone. Nonzero on failure. */
typedef int (*ctmhe_evaluate)(void *model, double t, const double *x, const double *u, const double *w, const double *p,
                              double *dx, double *y, double *J);

enum ctmhe_method { CTMHE_STEP_MAP = 0, CTMHE_RK4 = 1 };

typedef struct {
  int32_t operation, target, left, right; /* see tape.h */
} ctmhe_instruction;

typedef struct {
  ctmhe_batch batch;          /* compiled function for several steps, or NULL */
  ctmhe_casadi function;      /* else for one, or NULL */
  long long *iw;              /* its work vectors */
  double *w;
  const ctmhe_instruction *tape; /* else its instructions, or NULL */
  const double *constants;
  double *registers;          /* CTMHE_BATCH each, aligned to 64 bytes */
  int tape_length;
  int sizes[3];               /* of results with elements that the tape leaves out: they are zero */
  ctmhe_evaluate evaluate;    /* else a model that evaluates itself, and how it is integrated, or NULL */
  void *model;
  double *work, *input;       /* its memory: see own.h; (nu) */
  int method;                 /* of ctmhe_method */
  ctmhe_buffer_eval eval;     /* else the VM's buffer */
  void *self;
  const int *failed;          /* set by the VM's wrapper when an evaluation failed; may be NULL */
  double *arg[9];             /* memory bound to the arguments: the core writes here (VM) or passes these pointers */
  double *res[3];             /* memory bound to the results */
} ctmhe_function;

typedef struct {
  int nx, nw, np, nu, ny, q;  /* np: all parameters of the stage function */
  int steps;                  /* of the longest slot */
  double step_length;         /* seconds, of the longest step */
  int symbolic;               /* `curvature` exists */
  ctmhe_function value, jacobian, curvature;
} ctmhe_stage;

typedef struct {
  int n;                      /* slots N */
  int p_estimated;            /* 0: p is held at prior[nx:] */
  int output_bounded;         /* y_lower / y_upper matter */
  const double *t, *h;        /* (N+1), (N) */
  const uint8_t *shared;      /* (N): slot k+1 shares the w of slot k */
  const double *u0, *u1;      /* (N, nu) */
  const double *prior;        /* (nx + np) */
  const double *L_prior;      /* (m, m), m = nx or nx + np */
  const double *L_w;          /* (N, nw, nw) */
  const double *L_y;          /* (N, q, ny, ny) */
  const double *y_data;       /* (N, q, ny) */
  const double *x_lower, *x_upper; /* (N+1, nx) */
  const double *w_lower, *w_upper; /* (N, nw) */
  const double *y_lower, *y_upper; /* (N, ny): output at the slot's last evaluation point */
  const double *p_lower, *p_upper; /* (np) */
  const double *x_scale, *w_scale, *p_scale, *y_scale;
} ctmhe_window;

typedef struct {
  int max_iterations;
  double tolerance;           /* of the cost, relative: what a further step would still gain */
  double accuracy;            /* of an evaluation, relative: round-off, or the tolerance of an adaptive integrator */
  double seconds;             /* after which no further iteration begins; <= 0: no limit */
  double (*clock)(void);      /* seconds; needed with a limit */
} ctmhe_options;

enum ctmhe_stop {             /* why the core stopped */
  CTMHE_CONVERGED = 0,
  CTMHE_ITERATION_LIMIT = 1,
  CTMHE_NOT_FINITE = 2,       /* the model is not finite at the guess, or failed there */
  CTMHE_NO_DECREASE = 3,      /* no step decreases the merit function */
  CTMHE_SINGULAR = 4,         /* no consistent set of active bounds, or a direction without curvature */
  CTMHE_DEADLINE = 5
};

typedef struct {              /* in and out */
  double *x;                  /* (N+1, nx): guess in, solution out */
  double *w;                  /* (N, nw) */
  double *p;                  /* (np) */
  int8_t *x_active, *w_active, *y_active, *p_active; /* -1, 0, +1; guess in, set at the solution out */
  double *y;                  /* (N, q, ny) out */
  double *dynamics_multiplier;/* (N, nx) out, scaled variables, cost J / 2 */
  double *x_multiplier, *w_multiplier, *y_multiplier, *p_multiplier; /* out, as the bounds */
  double cost, optimality, feasibility; /* out; feasibility: scaled defects and bound violations */
  int stop, iterations, factorizations; /* out */
} ctmhe_result;

typedef struct {              /* an estimator: what does not change from update to update */
  double interval;            /* cell on which w is constant, seconds; the step of a discrete model */
  double hold_limit, rate, prior_rate; /* seconds; discounts per second */
  int discrete, filtering, end_slot, input_linear, p_estimated;
  int diagonal_R, diagonal_point; /* the roots below are diagonal; root_S always is */
  const uint8_t *held, *linear; /* (ny) how each sensor's samples enter */
  const double *nodes, *shares; /* (r - 1) quadrature of an integration step */
  const double *root_P, *root_Q, *root_R, *root_point, *root_S; /* square roots of the weights; root_S may be NULL */
  const double *x_lower, *x_upper, *w_lower, *w_upper, *y_lower, *y_upper, *residual_lower, *residual_upper;
  const double *p_lower, *p_upper, *x_scale, *w_scale, *p_scale, *y_scale;
} ctmhe_estimator;

typedef struct {              /* one update: what is known, and where the results go */
  double start, end;          /* of the window, seconds */
  double last_end, since;     /* time of the last estimate; from when on this one defines the estimated trajectory */
  int growing;                /* the window starts at t0 */
  int capacity;               /* slots that there is room for */
  int y_count, u_count, path_count, last_n;
  int prepared;               /* the scratch is as ctmhe_prepare left it */
  int anchored;               /* the prior is `prior`, not the estimated trajectory at the start (3.18) */
  const double *y_t, *y;      /* (y_count), (y_count, ny) measurements up to the end, NaN missing */
  const double *u_t, *u;      /* (u_count), (u_count, nu) inputs */
  const double *path_t, *path; /* (path_count), (path_count, width): the estimated trajectory, a slot a row */
  const double *prior, *p;    /* (nx + np), (np) of the last estimate */
  const double *root_prior;   /* square root of the prior's weight, discount included; NULL: that of the estimator */
  const double *last;         /* the last solution's blocks, or NULL */
  const int8_t *last_active;
  double *values;             /* out: blocks in the order of solved.py */
  int8_t *active;
  double *path_times, *path_rows; /* out: what this solution adds to the path */
  int n, path_added, measured; /* out */
} ctmhe_request;

enum ctmhe_outcome {          /* besides ctmhe_stop: why there was no solve */
  CTMHE_ELSEWHERE = -1,       /* not covered here: the caller's own assembly decides */
  CTMHE_TOO_SMALL = -2        /* more slots than `capacity`: request->n says how many */
};

/* Bytes of scratch for updates of up to `capacity` slots, and doubles of a row of the path. */
size_t ctmhe_update_size(const ctmhe_stage *stage, int capacity);

/* Assemble the window and its guess into `window` and `result` (whose pointers it sets), without solving. Returns 0 or
 * an outcome. */
int ctmhe_assemble(const ctmhe_stage *stage, const ctmhe_estimator *estimator, ctmhe_request *request,
                   ctmhe_window *window, ctmhe_result *result, void *scratch);

/* What can be done before the newest measurement is there: assemble the window that is expected, linearise it at the
 * guess and factorise. The update that follows on the same scratch with `prepared` set repeats only what differs; its
 * results are the same to the last bit. Returns 0, CTMHE_NOT_FINITE or an outcome. */
int ctmhe_prepare(const ctmhe_stage *stage, const ctmhe_estimator *estimator, ctmhe_request *request,
                  ctmhe_window *window, ctmhe_result *result, void *scratch);

/* Assemble and solve. Returns the stop code or an outcome. */
int ctmhe_update(const ctmhe_stage *stage, const ctmhe_estimator *estimator, ctmhe_request *request,
                 const ctmhe_options *options, ctmhe_window *window, ctmhe_result *result, void *scratch);

/* Bytes of scratch that a window of n slots needs. */
size_t ctmhe_scratch_size(const ctmhe_stage *stage, int n);

/* Solve. Returns the stop code, also in result->stop. */
int ctmhe_solve(const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_options *options,
                ctmhe_result *result, void *scratch);

/* Covariance of (x at the window's end, estimated p), (m, m), and the number of directions that are determined, at a
 * point whose x, w, p are given: the inverse of half the Gauss-Newton Hessian of J reduced by the dynamics, bounds
 * ignored. Variances that the window does not determine are infinite, their covariances NaN. Returns CTMHE_CONVERGED or
 * CTMHE_NOT_FINITE. Scratch as for ctmhe_solve. */
int ctmhe_covariance(const ctmhe_stage *stage, const ctmhe_window *window, const ctmhe_result *point,
                     double *covariance, int *rank, void *scratch);

/* Sizes compiled in (all zero in the shipped build), and the version: a loader refuses what does not fit. */
void ctmhe_sizes(int *nx, int *nw, int *np, int *ny, int *q, int *version);

#ifdef __cplusplus
}
#endif
#endif
