/* A model-exchange FMU as a C function of (t, x, u, w, p), or a co-simulation FMU as a step map; FMI 2.0 and 3.0.
 *
 * The declarations of the two FMI standards that are needed are written out here, so that no header is. */
#ifndef CTMHE_FMU_H
#define CTMHE_FMU_H

#include <stddef.h>
#include <stdint.h>

#define CTMHE_FMU_VERSION 2

/* How the FMU's variables make up the model. All arrays belong to the caller and outlive the evaluator.
 *
 * The FMU's inputs that are set are u, inputs that are disturbed, or both: value = base + u + w. */
typedef struct {
  const char *library, *name, *token, *resources; /* path of the binary, instance name, GUID, URI (FMI 2) or path */
  const char *const *complaints;       /* categories of its log that tell what is wrong; their number */
  int complaint_count;
  int version, co_simulation;          /* 2 or 3; 0: model exchange */
  int nx, nu, nw, np, ny, inputs, starts;
  const uint32_t *x, *dx, *input, *p, *y, *start; /* value references; y only where y_state is -1 */
  const double *start_value, *input_base;
  const int *input_u, *input_w;        /* (inputs): index into u and into w, or -1 */
  const int *w_state, *w_output;       /* (nw): what w is added to, or -1 */
  const int *y_state;                  /* (ny): the state that y is, or -1 */
  const double *x_size, *input_size, *p_size; /* typical magnitudes: steps of differences */
  double start_time, step;             /* seconds; step: of co-simulation */
  int p_in_event_mode, inputs_in_event_mode; /* parameters, inputs are set in event mode instead of as they come */
  int directional;                     /* ask the FMU for directional derivatives */
  double reach;                        /* relative step of central differences */
  const uint8_t *differenced;          /* (nx + inputs + np): columns taken by differences all the same */
  const uint8_t *rows_differenced;     /* (nx + ny): likewise, rows */
} ctmhe_fmu_configuration;

enum ctmhe_fmu_call { SET_TIME, SET_STATES, SET_VALUES, GET_DERIVATIVES, GET_VALUES, DIRECTIONAL, DO_STEP, OTHER, CALLS };

/* Open an evaluator: load, instantiate, initialize. NULL, with the reason in `message`, when that fails. */
void *ctmhe_fmu_open(const ctmhe_fmu_configuration *configuration, char *message, size_t size);
void ctmhe_fmu_close(void *model);

/* dx (nx): derivatives, or the states one step later; y (ny); J (nx + ny rows; columns x, w, p; column-major). Any of
 * them may be NULL; without dx or y their rows of J are not written. Returns nonzero when the FMU cannot be evaluated
 * there, or something is not finite; the instance has then been made anew if it was spoilt. */
int ctmhe_fmu_evaluate(void *model, double t, const double *x, const double *u, const double *w, const double *p,
                       double *dx, double *y, double *J);

/* Values of real variables now, and the time of the first time event (HUGE_VAL: none). */
int ctmhe_fmu_get(void *model, const uint32_t *references, size_t n, double *values);
double ctmhe_fmu_next_event(void *model);

/* What happened: counts of calls (CALLS), of failed evaluations and of instances made; the last failure in words. */
void ctmhe_fmu_counts(void *model, int64_t *calls, int64_t *failures, int64_t *instances);
int64_t ctmhe_fmu_failures(void *model);

/* A new estimate, or a new attempt at it: lost workers are replaced again, a limited number of times. */
void ctmhe_fmu_begin(void *model);
const char *ctmhe_fmu_message(void *model);

/* Make as many calls of each kind (CALLS) at x, mixed as an evaluation mixes them: what they cost by themselves. */
int ctmhe_fmu_repeat(void *model, const double *x, const int64_t *calls);

/* Answer requests that come through a pipe, until it ends: the inside of a worker process. */
int ctmhe_fmu_serve(void *model, int in, int out);
/* An evaluator whose FMU lives in a worker at the other end of two pipes. `renew` is asked for a new worker when this
 * one has died or takes more than `seconds`; it returns 0 and the new ends. */
typedef int (*ctmhe_fmu_renew)(int *in, int *out);
void *ctmhe_fmu_remote(int nx, int nu, int nw, int np, int ny, int in, int out, double seconds, ctmhe_fmu_renew renew);

/* A logger for FMI 2: its environment is what hears the finished messages. */
typedef struct {
  void (*hear)(int status, const char *text);
} ctmhe_fmu_ear;
void ctmhe_fmu_listen(void *ear, const char *name, int status, const char *category, const char *text, ...);

int ctmhe_fmu_version(void);

#endif
