/* Evaluators: see fmu.h. One evaluator serves one thread. */
#define _POSIX_C_SOURCE 200809L /* pipes */
#include "calls.h"
#include "messages.h"

#include <fenv.h>
#include <math.h>

#ifdef _WIN32
#define API __declspec(dllexport)
#else
#include <fcntl.h>
#include <unistd.h>
#define API __attribute__((visibility("default")))
#endif

enum { STATE, INPUT, PARAMETER }; /* what a column of derivatives is by */
enum { ROUNDS = 1000 };           /* of an event iteration */

typedef struct remote remote;

typedef struct {
  const ctmhe_fmu_configuration *c;
  remote *away;                   /* the FMU lives in a worker, or NULL */
  library_handle library;
  functions f;
  callbacks2 callbacks;
  instance fmu;
  saved_state origin;             /* of a co-simulation: where every step starts */
  double next_event;
  int broken;                     /* the instance has to be made anew */
  int silent;                     /* it does not take wishes about its log */
  int outputs;                    /* y that are no states */
  uint32_t *unknown;              /* dx, then those outputs */
  int *row;                       /* of the outputs: index of y */
  int dx_differenced, y_differenced; /* any row of them */
  double *memory, *v, *set_v, *set_p, *taken, *high, *low;
  double set_t, *own_x, *own_p;   /* room for points that are moved */
  int known_t, known_v, known_p, placed; /* what the instance has been told is what set_* say; it is at the point */
  double t;                       /* the point: t, x, v, p */
  const double *x, *p;
  int straight;                   /* unknowns are the rows, in order, and nothing is differenced */
  int64_t calls[CALLS], failures, instances;
  const char *failed;             /* the call that failed */
  int failed_status;
  char told[512], message[1536];
} fmu;

static const char *const status_names[] = {"ok", "warning", "discard", "error", "fatal", "pending"};

static void listen2(void *environment, const char *name, int status, const char *category, const char *text, ...) {
  fmu *m = environment;
  va_list rest;
  (void)name, (void)category;
  if (!m || !text || status == FMI_OK) return;
  va_start(rest, text);
  write_message(m->told, sizeof m->told, text, rest);
  va_end(rest);
}

static void listen3(void *environment, int status, const char *category, const char *text) {
  fmu *m = environment;
  (void)category;
  if (m && text && status != FMI_OK) snprintf(m->told, sizeof m->told, "%s", text);
}

static inline int noted(fmu *m, int kind, const char *name, int status) {
  m->calls[kind]++;
  if (status == FMI_OK || status == FMI_WARNING) return 0;
  if (status >= FMI_ERROR) m->broken = status;
  m->failed = name, m->failed_status = status;
  return 1;
}

#define CALL(kind, name, ...) noted(m, kind, name, m->f.__VA_ARGS__)

static int set(fmu *m, const uint32_t *references, size_t n, const double *values) {
  if (n == 0) return 0;
  if (m->c->version == 2) return CALL(SET_VALUES, "fmi2SetReal", set2(m->fmu, references, n, values));
  return CALL(SET_VALUES, "fmi3SetFloat64", set3(m->fmu, references, n, values, n));
}

static int get(fmu *m, const uint32_t *references, size_t n, double *values) {
  if (n == 0) return 0;
  if (m->c->version == 2) return CALL(GET_VALUES, "fmi2GetReal", get2(m->fmu, references, n, values));
  return CALL(GET_VALUES, "fmi3GetFloat64", get3(m->fmu, references, n, values, n));
}

/* ---- an instance's life ----------------------------------------------------------------------------------------- */

static int iterate_events(fmu *m) {
  for (int round = 0; round < ROUNDS; round++) {
    event_info2 e = {0, 0, 0, 0, 0, 0.0};
    if (m->c->version == 2) {
      if (CALL(OTHER, "fmi2NewDiscreteStates", discrete2(m->fmu, &e))) return 1;
    } else {
      bool again = false, terminate = false, nominals = false, states = false, planned = false;
      if (CALL(OTHER, "fmi3UpdateDiscreteStates",
               discrete3(m->fmu, &again, &terminate, &nominals, &states, &planned, &e.next)))
        return 1;
      e.again = again, e.terminate = terminate, e.planned = planned;
    }
    if (e.terminate) {
      m->failed = "the event iteration, which asks to end the simulation,", m->failed_status = m->broken = FMI_ERROR;
      return 1;
    }
    m->next_event = e.planned ? e.next : HUGE_VAL;
    if (!e.again) return CALL(OTHER, "fmiXEnterContinuousTimeMode", enter_continuous(m->fmu));
  }
  m->failed = "the event iteration, which does not end,", m->failed_status = m->broken = FMI_ERROR;
  return 1;
}

static int initialize(fmu *m) {
  const ctmhe_fmu_configuration *c = m->c;
  if (set(m, c->start, (size_t)c->starts, c->start_value)) return 1;
  if (c->version == 2) {
    if (CALL(OTHER, "fmi2SetupExperiment", setup2(m->fmu, 0, 0.0, c->start_time, 0, 0.0))) return 1;
    if (CALL(OTHER, "fmi2EnterInitializationMode", enter_initialization2(m->fmu))) return 1;
  } else if (CALL(OTHER, "fmi3EnterInitializationMode",
                  enter_initialization3(m->fmu, false, 0.0, c->start_time, false, 0.0))) {
    return 1;
  }
  if (CALL(OTHER, "fmiXExitInitializationMode", exit_initialization(m->fmu))) return 1;
  if (!c->co_simulation) return iterate_events(m);
  return c->step > 0.0 ? CALL(OTHER, "fmiXGetFMUState", save(m->fmu, &m->origin)) : 0;
}

static void discard_instance(fmu *m) {
  if (m->fmu && m->broken < FMI_FATAL) {
    if (m->origin && m->f.forget) m->f.forget(m->fmu, &m->origin);
    m->f.release(m->fmu);
  }
  m->fmu = NULL, m->origin = NULL;
}

static instance made(fmu *m, int logging) {
  const ctmhe_fmu_configuration *c = m->c;
  if (c->version == 2)
    return m->f.instantiate2(c->name, c->co_simulation, c->token, c->resources, &m->callbacks, 0, logging);
  if (c->co_simulation)
    return m->f.instantiate_simulation3(c->name, c->token, c->resources, false, logging, false, false, NULL, 0, m,
                                        listen3, NULL);
  return m->f.instantiate_exchange3(c->name, c->token, c->resources, false, logging, m, listen3);
}

/* Have the FMU tell what is wrong, and nothing else: all that it could tell takes long. Returns whether it failed. */
static int ask_for_complaints(fmu *m) {
  const ctmhe_fmu_configuration *c = m->c;
  const size_t n = (size_t)c->complaint_count;
  if (n == 0) return 0;
  if (m->f.debug2) return m->f.debug2(m->fmu, 1, n, c->complaints) > FMI_WARNING;
  return m->f.debug3 && m->f.debug3(m->fmu, true, n, c->complaints) > FMI_WARNING;
}

/* Make the instance, or make it anew; use `instantiate`. */
static int instantiate_anyhow(fmu *m) {
  discard_instance(m);
  m->broken = m->known_t = m->known_v = m->known_p = m->placed = 0;
  m->instances++;
  m->fmu = made(m, 0);
  if (!m->fmu && !m->told[0]) m->fmu = made(m, 1); /* to hear why */
  if (m->fmu && !m->silent && ask_for_complaints(m)) { /* after an error an instance is of no use */
    m->silent = 1;
    m->f.release(m->fmu);
    m->fmu = made(m, 0);
  }
  if (!m->fmu) {
    m->failed = "the instantiation", m->failed_status = FMI_ERROR;
    m->broken = FMI_ERROR;
    return 1;
  }
  if (!initialize(m)) return 0;
  if (!m->broken) m->broken = FMI_ERROR; /* discarded: no better for it */
  return 1;
}

/* Some FMUs leave another rounding mode, or traps, or go to another folder, which our host must not notice. */
static int instantiate(fmu *m) {
  fenv_t ours;
  fegetenv(&ours);
#ifndef _WIN32
  const int here = open(".", O_RDONLY | O_CLOEXEC);
#endif
  const int failed = instantiate_anyhow(m);
#ifndef _WIN32
  if (here >= 0) {
    (void)!fchdir(here);
    close(here);
  }
#endif
  fesetenv(&ours);
  return failed;
}

/* ---- values ----------------------------------------------------------------------------------------------------- */

/* Take the instance to a point; what it has been told already is not repeated. */
static int settle(fmu *m, double t, const double *x, const double *v, const double *p) {
  const ctmhe_fmu_configuration *c = m->c;
  const size_t nx = (size_t)c->nx, nv = (size_t)c->inputs, np = (size_t)c->np;
  m->placed = 0;
  if (c->co_simulation) {
    if (CALL(OTHER, "fmiXSetFMUState", load(m->fmu, m->origin))) return 1;
    return set(m, c->p, np, p) || set(m, c->x, nx, x) || set(m, c->input, nv, v);
  }
  if (np && !(m->known_p && memcmp(m->set_p, p, np * sizeof *p) == 0)) {
    m->known_p = 0;
    if (c->p_in_event_mode && CALL(OTHER, "fmiXEnterEventMode", enter_events(m->fmu))) return 1;
    if (set(m, c->p, np, p)) return 1;
    if (c->p_in_event_mode && iterate_events(m)) return 1;
    memcpy(m->set_p, p, np * sizeof *p);
    m->known_p = 1;
  }
  if (!(m->known_t && m->set_t == t)) {
    m->known_t = 0;
    if (CALL(SET_TIME, "fmiXSetTime", set_time(m->fmu, t))) return 1;
    m->set_t = t, m->known_t = 1;
  }
  if (nv && !(m->known_v && memcmp(m->set_v, v, nv * sizeof *v) == 0)) {
    m->known_v = 0;
    if (c->inputs_in_event_mode && CALL(OTHER, "fmiXEnterEventMode", enter_events(m->fmu))) return 1;
    if (set(m, c->input, nv, v)) return 1;
    if (c->inputs_in_event_mode && iterate_events(m)) return 1;
    memcpy(m->set_v, v, nv * sizeof *v);
    m->known_v = 1;
  }
  return CALL(SET_STATES, "fmiXSetContinuousStates", set_states(m->fmu, x, nx));
}

/* The FMU's own dx and y where it is; either may be NULL. */
static int read_values(fmu *m, const double *x, double *dx, double *y) {
  const ctmhe_fmu_configuration *c = m->c;
  const size_t nx = (size_t)c->nx;
  if (dx && !c->co_simulation && CALL(GET_DERIVATIVES, "fmiXGetDerivatives", derivatives(m->fmu, dx, nx))) return 1;
  if (y) {
    if (get(m, m->unknown + nx, (size_t)m->outputs, m->taken)) return 1;
    for (int i = 0; i < m->outputs; i++) y[m->row[i]] = m->taken[i];
    for (int i = 0; i < c->ny; i++)
      if (c->y_state[i] >= 0) y[i] = x[c->y_state[i]];
  }
  if (dx && c->co_simulation) { /* outputs belong to the step's start */
    if (c->version == 2) {
      if (CALL(DO_STEP, "fmi2DoStep", step2(m->fmu, c->start_time, c->step, 0))) return 1;
    } else {
      bool event = false, terminate = false, early = false;
      double last = 0.0;
      if (CALL(DO_STEP, "fmi3DoStep", step3(m->fmu, c->start_time, c->step, false, &event, &terminate, &early, &last)))
        return 1;
      if (terminate || early) {
        m->failed = "fmi3DoStep, which ended early,", m->failed_status = FMI_DISCARD;
        return 1;
      }
    }
    if (get(m, c->x, nx, dx)) return 1;
  }
  return 0;
}

static int all_finite(const double *values, int n) {
  double sum = 0.0;
  for (int i = 0; i < n; i++) sum += values[i] * 0.0;
  return sum == 0.0;
}

static int values_at(fmu *m, double t, const double *x, const double *v, const double *p, double *dx, double *y) {
  const int asks = dx || m->outputs; /* else y is made of states */
  if ((asks && settle(m, t, x, v, p)) || read_values(m, x, dx, y)) return 1;
  if ((dx && !all_finite(dx, m->c->nx)) || (y && !all_finite(y, m->c->ny))) {
    m->failed = "a value, which is not finite,", m->failed_status = FMI_DISCARD;
    return 1;
  }
  return 0;
}

/* ---- derivatives ------------------------------------------------------------------------------------------------ */

static int renewed(fmu *m) { return m->broken && instantiate(m); }

/* Rows of dx and y (from nx on) at the point, moved by `step` along one coordinate, which is the evaluator's own copy;
 * the result of a failure is 1. */
static int moved(fmu *m, double *coordinate, double step, int want_dx, int want_y, double *values) {
  const double kept = *coordinate;
  *coordinate = kept + step;
  const int failed = renewed(m) || values_at(m, m->t, m->x, m->v, m->p, want_dx ? values : NULL,
                                             want_y ? values + m->c->nx : NULL);
  *coordinate = kept;
  return failed;
}

/* A central difference; one-sided where the FMU cannot be evaluated on the other side. */
static int difference(fmu *m, int group, int j, double size, int want_dx, int want_y, double *D) {
  const int nx = m->c->nx, rows = nx + m->c->ny;
  double *coordinate = (group == STATE ? m->own_x : group == INPUT ? m->v : m->own_p) + j;
  if (m->x != m->own_x) memcpy(m->own_x, m->x, (size_t)nx * sizeof *m->x);
  if (m->p != m->own_p && m->c->np) memcpy(m->own_p, m->p, (size_t)m->c->np * sizeof *m->p);
  m->x = m->own_x, m->p = m->own_p;
  const double step = m->c->reach * (fabs(*coordinate) > size ? fabs(*coordinate) : size);
  int above = !moved(m, coordinate, step, want_dx, want_y, m->high);
  int below = !moved(m, coordinate, -step, want_dx, want_y, m->low);
  if (!above && !below) return 1;
  if (!above || !below) {
    if (moved(m, coordinate, 0.0, want_dx, want_y, above ? m->low : m->high)) return 1;
  }
  const double width = above && below ? 2 * step : step;
  for (int i = want_dx ? 0 : nx; i < (want_y ? rows : nx); i++) D[i] = (m->high[i] - m->low[i]) / width;
  return 0;
}

/* One column of the derivatives at the point. */
static int column(fmu *m, int group, int j, int want_dx, int want_y, double *D) {
  const ctmhe_fmu_configuration *c = m->c;
  const int nx = c->nx, flat = group == STATE ? j : group == INPUT ? nx + j : nx + c->inputs + j;
  const int asked = c->directional && !c->differenced[flat];
  const double *const sizes[] = {c->x_size, c->input_size, c->p_size};
  const uint32_t *const references[] = {c->x, c->input, c->p};
  if (!asked || (want_dx && m->dx_differenced) || (want_y && m->y_differenced))
    if (difference(m, group, j, sizes[group][j], want_dx, want_y, D)) return 1;
  if (asked) {
    const double one = 1.0;
    const size_t n = (size_t)((want_dx ? nx : 0) + (want_y ? m->outputs : 0));
    const uint32_t *unknown = m->unknown + (want_dx ? 0 : nx), *known = references[group] + j;
    double *into = want_dx ? m->taken : m->taken + nx;
    if (n && (renewed(m) || (!m->placed && settle(m, m->t, m->x, m->v, m->p)))) return 1;
    m->placed |= n > 0;
    if (n == 0) { /* all y are states */
    } else if (c->version == 2) {
      if (CALL(DIRECTIONAL, "fmi2GetDirectionalDerivative", directional2(m->fmu, unknown, n, known, 1, &one, into)))
        return 1;
    } else if (CALL(DIRECTIONAL, "fmi3GetDirectionalDerivative",
                    directional3(m->fmu, unknown, n, known, 1, &one, 1, into, n))) {
      return 1;
    }
    for (int i = 0; want_dx && i < nx; i++)
      if (!c->rows_differenced[i]) D[i] = m->taken[i];
    for (int i = 0; want_y && i < m->outputs; i++)
      if (!c->rows_differenced[nx + m->row[i]]) D[nx + m->row[i]] = m->taken[nx + i];
  }
  for (int i = 0; want_y && i < c->ny; i++)
    if (c->y_state[i] >= 0) D[nx + i] = group == STATE && c->y_state[i] == j;
  if (!all_finite(D + (want_dx ? 0 : nx), (want_dx ? nx : 0) + (want_y ? c->ny : 0))) {
    m->failed = "a derivative, which is not finite,", m->failed_status = FMI_DISCARD;
    return 1;
  }
  return 0;
}

/* Columns of directional derivatives, all rows at once, where nothing has to be rearranged. */
static int straight(fmu *m, int group, int count, int want_dx, int want_y, double *D) {
  const ctmhe_fmu_configuration *c = m->c;
  const int nx = c->nx, rows = nx + c->ny, first = want_dx ? 0 : nx;
  const uint32_t *known = group == STATE ? c->x : c->p, *unknown = m->unknown + first;
  const size_t n = (size_t)((want_y ? rows : nx) - first);
  const double one = 1.0;
  if (!m->placed && settle(m, m->t, m->x, m->v, m->p)) return 1;
  m->placed = 1;
  D += first;
  if (c->version == 2) {
    for (int j = 0; j < count; j++, D += rows)
      if (CALL(DIRECTIONAL, "fmi2GetDirectionalDerivative", directional2(m->fmu, unknown, n, known + j, 1, &one, D)))
        return 1;
  } else {
    for (int j = 0; j < count; j++, D += rows)
      if (CALL(DIRECTIONAL, "fmi3GetDirectionalDerivative", directional3(m->fmu, unknown, n, known + j, 1, &one, 1, D, n)))
        return 1;
  }
  return 0;
}

/* Columns of one group; those of states and parameters lie side by side. */
static int columns(fmu *m, int group, int count, int want_dx, int want_y, double *D) {
  const int rows = m->c->nx + m->c->ny;
  if (count == 0) return 0;
  if (m->straight && (want_dx || m->outputs) && (!want_y || m->outputs == m->c->ny)) {
    if (straight(m, group, count, want_dx, want_y, D)) return 1;
    for (int j = 0; j < count; j++)
      if (!all_finite(D + j * rows + (want_dx ? 0 : m->c->nx), (want_dx ? m->c->nx : 0) + (want_y ? m->c->ny : 0))) {
        m->failed = "a derivative, which is not finite,", m->failed_status = FMI_DISCARD;
        return 1;
      }
    return 0;
  }
  for (int j = 0; j < count; j++)
    if (column(m, group, j, want_dx, want_y, D + j * rows)) return 1;
  return 0;
}

static void place(fmu *m, double t, const double *x, const double *u, const double *w, const double *p) {
  const ctmhe_fmu_configuration *c = m->c;
  m->t = t, m->x = x, m->p = p;
  for (int i = 0; i < c->inputs; i++) {
    double value = c->input_u[i] >= 0 ? u[c->input_u[i]] : c->input_base[i];
    if (c->input_w[i] >= 0) value += w[c->input_w[i]];
    m->v[i] = value;
  }
}

/* The call that failed and its status. */
static int name_failure(const fmu *m, char *text, size_t size) {
  const int status = m->failed_status > FMI_PENDING ? FMI_PENDING : m->failed_status;
  if (strncmp(m->failed, "fmiX", 4) == 0)
    return snprintf(text, size, "fmi%d%s gave '%s'", m->c->version, m->failed + 4, status_names[status]);
  return snprintf(text, size, "%s gave '%s'", m->failed, status_names[status]);
}

/* Put the failure into words, and have a spoilt instance made anew. */
static int failed(fmu *m) {
  const ctmhe_fmu_configuration *c = m->c;
  const struct {
    const char *name;
    const double *values;
    int n;
  } parts[] = {{"x", m->x, c->nx}, {"inputs", m->v, c->inputs}, {"p", m->p, c->np}};
  size_t used = (size_t)name_failure(m, m->message, sizeof m->message);
#define SAY(...)                                                                            \
  do {                                                                                      \
    if (used + 1 < sizeof m->message)                                                       \
      used += (size_t)snprintf(m->message + used, sizeof m->message - used, __VA_ARGS__);   \
  } while (0)
  SAY(" at t = %.8g", m->t);
  for (int k = 0; k < 3; k++) {
    for (int i = 0; parts[k].values && i < parts[k].n && used < 700; i++) {
      if (i == 0) SAY(", %s = [", parts[k].name);
      SAY(i ? ", %.8g" : "%.8g", parts[k].values[i]);
    }
    if (parts[k].values && parts[k].n) SAY("]");
  }
  if (m->told[0]) SAY("; it says: %s", m->told);
#undef SAY
  m->told[0] = 0;
  m->failures++;
  if (m->broken) instantiate(m);
  return 1;
}

/* ---- entry points ----------------------------------------------------------------------------------------------- */

#include "remote.h"

API void ctmhe_fmu_listen(void *ear, const char *name, int status, const char *category, const char *text, ...) {
  char message[2048];
  va_list rest;
  (void)name, (void)category;
  if (!ear || !text) return;
  va_start(rest, text);
  write_message(message, sizeof message, text, rest);
  va_end(rest);
  ((const ctmhe_fmu_ear *)ear)->hear(status, message);
}

API int ctmhe_fmu_version(void) { return CTMHE_FMU_VERSION; }

static void *give_up(fmu *m, char *message, size_t size) {
  if (m->failed) {
    const size_t used = (size_t)name_failure(m, message, size);
    if (m->told[0] && used < size) snprintf(message + used, size - used, "; it says: %s", m->told);
  }
  ctmhe_fmu_close(m);
  return NULL;
}

API void *ctmhe_fmu_open(const ctmhe_fmu_configuration *c, char *message, size_t size) {
  fmu *m = calloc(1, sizeof *m);
  if (!m) return NULL;
  const size_t nx = (size_t)c->nx, nv = (size_t)c->inputs, np = (size_t)c->np, rows = nx + (size_t)c->ny;
  m->c = c;
  m->callbacks = (callbacks2){listen2, calloc, free, NULL, m};
  m->unknown = calloc(rows + 1, sizeof *m->unknown);
  m->row = calloc(rows + 1, sizeof *m->row);
  m->memory = calloc(nx + 2 * nv + 2 * np + 3 * rows + 1, sizeof *m->memory);
  if (!m->unknown || !m->row || !m->memory) {
    snprintf(message, size, "out of memory");
    return give_up(m, message, size);
  }
  m->own_x = m->memory, m->v = m->own_x + nx, m->own_p = m->v + nv, m->set_v = m->own_p + np, m->set_p = m->set_v + nv;
  m->taken = m->set_p + np, m->high = m->taken + rows, m->low = m->high + rows;
  memcpy(m->unknown, c->dx, nx * sizeof *c->dx);
  for (int i = 0; i < c->ny; i++) {
    if (c->y_state[i] >= 0) continue;
    m->unknown[nx + (size_t)m->outputs] = c->y[i];
    m->row[m->outputs++] = i;
    m->y_differenced |= c->rows_differenced[nx + (size_t)i];
  }
  for (size_t i = 0; i < nx; i++) m->dx_differenced |= c->rows_differenced[i];
  m->straight = c->directional && !m->dx_differenced && !m->y_differenced;
  for (int i = 0; i < c->nx + c->inputs + c->np; i++) m->straight &= !c->differenced[i];
  m->next_event = HUGE_VAL;
  fenv_t ours;
  fegetenv(&ours); /* libraries made with -ffast-math make small numbers zero in the whole thread */
  m->library = open_library(c->library, message, size);
  fesetenv(&ours);
  if (!m->library) return give_up(m, message, size);
  const char *missing = find_functions(m->library, c->version, c->co_simulation, &m->f);
  if (!missing && c->directional && !(c->version == 2 ? m->f.directional2 != NULL : m->f.directional3 != NULL))
    missing = "its function for directional derivatives";
  if (!missing && c->co_simulation && c->step > 0.0 && !(m->f.save && m->f.load)) missing = "its functions to save and load its state";
  if (missing) {
    snprintf(message, size, "%s is missing", missing);
    return give_up(m, message, size);
  }
  if (instantiate(m)) return give_up(m, message, size);
  m->told[0] = 0;
  return m;
}

API void ctmhe_fmu_close(void *model) {
  fmu *m = model;
  if (!m) return;
  discard_instance(m);
  if (m->library) close_library(m->library);
  free(m->away);
  free(m->unknown);
  free(m->row);
  free(m->memory);
  free(m);
}

API int ctmhe_fmu_evaluate(void *model, double t, const double *x, const double *u, const double *w, const double *p,
                           double *dx, double *y, double *J) {
  fmu *m = model;
  if (m->away) return ask(m, t, x, u, w, p, dx, y, J);
  const ctmhe_fmu_configuration *c = m->c;
  const int nx = c->nx, ny = c->ny, rows = nx + ny;
  place(m, t, x, u, w, p);
  if (renewed(m)) return failed(m);
  if (values_at(m, t, m->x, m->v, m->p, dx, y)) return failed(m);
  m->placed = !c->co_simulation && (dx || m->outputs);
  for (int i = 0; i < c->nw; i++) {
    if (dx && c->w_state[i] >= 0) dx[c->w_state[i]] += w[i];
    if (y && c->w_output[i] >= 0) y[c->w_output[i]] += w[i];
  }
  if (!J) return 0;
  if (columns(m, STATE, nx, dx != NULL, y != NULL, J)) return failed(m);
  for (int j = 0; j < c->nw; j++) {
    double *D = J + (nx + j) * rows;
    memset(D, 0, (size_t)rows * sizeof *D);
    if (c->w_state[j] >= 0) D[c->w_state[j]] = 1.0;
    if (c->w_output[j] >= 0) D[nx + c->w_output[j]] = 1.0;
  }
  for (int j = 0; j < c->inputs; j++)
    if (c->input_w[j] >= 0 && column(m, INPUT, j, dx != NULL, y != NULL, J + (nx + c->input_w[j]) * rows))
      return failed(m);
  if (columns(m, PARAMETER, c->np, dx != NULL, y != NULL, J + (nx + c->nw) * rows)) return failed(m);
  return 0;
}

API int ctmhe_fmu_get(void *model, const uint32_t *references, size_t n, double *values) {
  fmu *m = model;
  if (renewed(m) || get(m, references, n, values)) return failed(m);
  return 0;
}

API double ctmhe_fmu_next_event(void *model) { return ((fmu *)model)->next_event; }

API void ctmhe_fmu_counts(void *model, int64_t *calls, int64_t *failures, int64_t *instances) {
  const fmu *m = model;
  memcpy(calls, m->calls, sizeof m->calls);
  *failures = m->failures, *instances = m->instances;
}

API void ctmhe_fmu_begin(void *model) {
  fmu *m = model;
  if (m->away) m->away->lives = LIVES;
}

API int64_t ctmhe_fmu_failures(void *model) { return ((fmu *)model)->failures; }

API const char *ctmhe_fmu_message(void *model) { return ((fmu *)model)->message; }

API int ctmhe_fmu_repeat(void *model, const double *x, const int64_t *calls) {
  fmu *m = model;
  const ctmhe_fmu_configuration *c = m->c;
  const double one = 1.0;
  int64_t most = 0, made[CALLS] = {0};
  int bad = 0;
  for (int kind = 0; kind < OTHER; kind++) most = calls[kind] > most ? calls[kind] : most;
  for (int64_t round = 1; round <= most && !bad; round++)
    for (int kind = 0; kind < DO_STEP; kind++)
      for (; made[kind] * most < calls[kind] * round; made[kind]++) {
        const int j = c->nx ? (int)(made[kind] % c->nx) : 0;
        const size_t n = (size_t)(c->nx + m->outputs);
        if (kind == SET_TIME) bad |= m->f.set_time(m->fmu, m->t) > FMI_WARNING;
        if (kind == SET_STATES) bad |= m->f.set_states(m->fmu, x, (size_t)c->nx) > FMI_WARNING;
        if (kind == SET_VALUES && c->version == 2)
          bad |= m->f.set2(m->fmu, c->input, (size_t)c->inputs, m->v) > FMI_WARNING;
        if (kind == SET_VALUES && c->version == 3)
          bad |= m->f.set3(m->fmu, c->input, (size_t)c->inputs, m->v, (size_t)c->inputs) > FMI_WARNING;
        if (kind == GET_DERIVATIVES) bad |= m->f.derivatives(m->fmu, m->taken, (size_t)c->nx) > FMI_WARNING;
        if (kind == GET_VALUES && c->version == 2)
          bad |= m->f.get2(m->fmu, m->unknown + c->nx, (size_t)m->outputs, m->taken) > FMI_WARNING;
        if (kind == GET_VALUES && c->version == 3)
          bad |= m->f.get3(m->fmu, m->unknown + c->nx, (size_t)m->outputs, m->taken, (size_t)m->outputs) > FMI_WARNING;
        if (kind == DIRECTIONAL && c->version == 2)
          bad |= m->f.directional2(m->fmu, m->unknown, n, c->x + j, 1, &one, m->taken) > FMI_WARNING;
        if (kind == DIRECTIONAL && c->version == 3)
          bad |= m->f.directional3(m->fmu, m->unknown, n, c->x + j, 1, &one, 1, m->taken, n) > FMI_WARNING;
      }
  return bad;
}
