/* An FMU in a worker process: the same questions, through pipes. */
#ifndef CTMHE_REMOTE_H
#define CTMHE_REMOTE_H

/* A question is its kind, then t, x, u, w, p; the answer a status, then dx, y, J, or the length of a message, then
 * that. Numbers are doubles: both ends are this machine. */
enum { ASK_DX = 1, ASK_Y = 2, ASK_J = 4 };

#ifdef _WIN32

struct remote {
  int lives;
};

enum { LIVES = 0 };

static int ask(fmu *m, double t, const double *x, const double *u, const double *w, const double *p, double *dx,
               double *y, double *J) {
  (void)m, (void)t, (void)x, (void)u, (void)w, (void)p, (void)dx, (void)y, (void)J;
  return 1;
}

API int ctmhe_fmu_serve(void *model, int in, int out) { return (void)model, (void)in, (void)out, 1; }

API void *ctmhe_fmu_remote(int nx, int nu, int nw, int np, int ny, int in, int out, double seconds,
                           ctmhe_fmu_renew renew) {
  (void)nx, (void)nu, (void)nw, (void)np, (void)ny, (void)in, (void)out, (void)seconds, (void)renew;
  return NULL;
}

#else

enum { LIVES = 10 }; /* workers that may be lost until ctmhe_fmu_begin: a new one takes a while, and a solve may try often */

#include <errno.h>
#include <poll.h>
#include <unistd.h>

struct remote {
  int nx, nu, nw, np, ny, in, out, dead, lives;
  pid_t owner;                    /* a forked child needs a worker of its own */
  double seconds;
  ctmhe_fmu_renew renew;
  double buffer[];
};

/* Read or write everything; `wait` (milliseconds, -1: for ever) bounds each silence. Returns nonzero on failure. */
static int transfer(int file, void *data, size_t size, int writing, int wait) {
  char *at = data;
  while (size) {
    struct pollfd ready = {file, writing ? POLLOUT : POLLIN, 0};
    const int polled = poll(&ready, 1, wait);
    if (polled < 0 && errno == EINTR) continue;
    if (polled <= 0) return polled == 0 ? 2 : 1;
    const ssize_t n = writing ? write(file, at, size) : read(file, at, size);
    if (n < 0 && (errno == EINTR || errno == EAGAIN)) continue;
    if (n <= 0) return 1;
    at += n, size -= (size_t)n;
  }
  return 0;
}

static size_t question_size(const remote *r) { return 2 + (size_t)(r->nx + r->nu + r->nw + r->np); }

static size_t answer_size(const remote *r, int kind) {
  const size_t nx = (size_t)r->nx, ny = (size_t)r->ny;
  return 1 + (kind & ASK_DX ? nx : 0) + (kind & ASK_Y ? ny : 0) +
         (kind & ASK_J ? (nx + ny) * (size_t)(r->nx + r->nw + r->np) : 0);
}

static int lost(fmu *m, double t, const double *x, const char *what) {
  remote *r = m->away;
  size_t used = (size_t)snprintf(m->message, sizeof m->message, "the worker process %s at t = %.8g", what, t);
  for (int i = 0; i < r->nx && used < 700; i++)
    used += (size_t)snprintf(m->message + used, sizeof m->message - used, i ? ", %.8g" : ", x = [%.8g", x[i]);
  if (used + 2 < sizeof m->message) memcpy(m->message + used, "]", 2);
  m->failures++;
  m->instances++;
  r->dead = --r->lives > 0 ? r->renew(&r->in, &r->out) : 1;
  return 1;
}

static int ask(fmu *m, double t, const double *x, const double *u, const double *w, const double *p, double *dx,
               double *y, double *J) {
  remote *r = m->away;
  const int kind = (dx ? ASK_DX : 0) | (y ? ASK_Y : 0) | (J ? ASK_J : 0), wait = (int)(1e3 * r->seconds);
  const struct {
    const double *values;
    int n;
  } parts[] = {{x, r->nx}, {u, r->nu}, {w, r->nw}, {p, r->np}};
  double *at = r->buffer, status;
  if (r->owner != getpid()) r->owner = getpid(), r->dead = 1;
  if (r->dead && (r->lives <= 0 || (r->dead = r->renew(&r->in, &r->out)))) {
    m->failures++;
    return 1;
  }
  *at++ = kind, *at++ = t;
  for (int k = 0; k < 4; k++)
    for (int i = 0; i < parts[k].n; i++) *at++ = parts[k].values[i];
  if (transfer(r->out, r->buffer, question_size(r) * sizeof(double), 1, wait)) return lost(m, t, x, "is gone");
  const int silent = transfer(r->in, &status, sizeof status, 0, wait);
  if (silent) return lost(m, t, x, silent == 2 ? "did not answer in time" : "died");
  if (status != 0.0) { /* the length of a message */
    size_t size = (size_t)status;
    if (size >= sizeof m->message || transfer(r->in, m->message, size, 0, wait)) return lost(m, t, x, "died");
    m->message[size] = 0;
    m->failures++;
    return 1;
  }
  if (transfer(r->in, r->buffer, (answer_size(r, kind) - 1) * sizeof(double), 0, wait)) return lost(m, t, x, "died");
  at = r->buffer;
  if (dx) memcpy(dx, at, (size_t)r->nx * sizeof *at), at += r->nx;
  if (y) memcpy(y, at, (size_t)r->ny * sizeof *at), at += r->ny;
  if (J) memcpy(J, at, (size_t)((r->nx + r->ny) * (r->nx + r->nw + r->np)) * sizeof *at);
  return 0;
}

static remote *new_remote(int nx, int nu, int nw, int np, int ny) {
  const remote sizes = {nx, nu, nw, np, ny, -1, -1, 0, LIVES, getpid(), 0.0, NULL};
  const size_t given = question_size(&sizes), taken = answer_size(&sizes, ASK_DX | ASK_Y | ASK_J);
  remote *r = malloc(sizeof *r + (given > taken ? given : taken) * sizeof(double));
  if (r) *r = sizes;
  return r;
}

API void *ctmhe_fmu_remote(int nx, int nu, int nw, int np, int ny, int in, int out, double seconds,
                           ctmhe_fmu_renew renew) {
  fmu *m = calloc(1, sizeof *m);
  if (!m) return NULL;
  m->away = new_remote(nx, nu, nw, np, ny);
  m->instances = 1;
  if (!m->away) {
    free(m);
    return NULL;
  }
  m->away->in = in, m->away->out = out, m->away->seconds = seconds, m->away->renew = renew;
  return m;
}

API int ctmhe_fmu_serve(void *model, int in, int out) {
  fmu *m = model;
  const ctmhe_fmu_configuration *c = m->c;
  remote *r = new_remote(c->nx, c->nu, c->nw, c->np, c->ny);
  if (!r) return 1;
  const size_t given = question_size(r);
  double *const answer = malloc((answer_size(r, ASK_DX | ASK_Y | ASK_J)) * sizeof(double));
  int stop = answer == NULL;
  while (!stop && !transfer(in, r->buffer, given * sizeof(double), 0, -1)) {
    const int kind = (int)r->buffer[0];
    const double t = r->buffer[1], *x = r->buffer + 2, *u = x + c->nx, *w = u + c->nu, *p = w + c->nw;
    double *dx = answer + 1, *y = dx + (kind & ASK_DX ? c->nx : 0), *J = y + (kind & ASK_Y ? c->ny : 0);
    if (ctmhe_fmu_evaluate(m, t, x, u, w, p, kind & ASK_DX ? dx : NULL, kind & ASK_Y ? y : NULL,
                           kind & ASK_J ? J : NULL)) {
      size_t size = strlen(m->message);
      answer[0] = (double)size;
      stop = transfer(out, answer, sizeof *answer, 1, -1) || transfer(out, m->message, size, 1, -1);
    } else {
      answer[0] = 0.0;
      stop = transfer(out, answer, answer_size(r, kind) * sizeof *answer, 1, -1);
    }
  }
  free(answer);
  free(r);
  return 0;
}

#endif
#endif
