/* An oscillator as FMI 2.0 model exchange, by nobody's framework: der(x) = v, der(v) = -k x - c v + force.
 *
 * Strict about modes and about what may be set and asked where; der(x) shares the value reference of v, and y that of
 * x; value references are in no order. What is switched on by a macro:
 *   INITIAL_EQUATION   v = -k / 2 at the end of the initialization, and cannot be set
 *   NO_RESOURCE        it cannot be instantiated, and tells why
 *   NO_VALUES          no value can be read
 *   PYTHON             it needs a module that the session can import
 *   ROUNDS_UP          it leaves another rounding mode, and traps on
 *   TIRES              it discards every evaluation after the first 40 of an instance
 *   ENDLESS            it cannot be ended, and tells when it is freed
 *   GOES_AWAY          it leaves another working directory */
#define _GNU_SOURCE
#include <fenv.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi2Functions.h"

enum { MADE = 1, INITIALIZING = 2, EVENT = 4, CONTINUOUS = 8, FAILED = 16 };
enum { X = 900, V = 17, DER_V = 3, FORCE = 42, SAMPLED = 43, K = 5, C = 6, ENERGY = 8 };

typedef struct {
  fmi2CallbackFunctions callbacks;
  int mode, tells, evaluations;
  double x, v, force, sampled, k, c;
} oscillator;

static fmi2Status refuse(oscillator *m, const char *what) {
  if (m->tells)
    m->callbacks.logger(m->callbacks.componentEnvironment, "stranger", fmi2Error, "logStatusError", "%s is refused in mode %d", what, m->mode);
  m->mode = FAILED;
  return fmi2Error;
}

#define ONLY(modes, what) \
  if (!(((oscillator *)c)->mode & (modes))) return refuse(c, what)

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
  oscillator *m = callbacks->allocateMemory(1, sizeof *m);
  *m = (oscillator){*callbacks, MADE, logging, 0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.3};
#ifdef NO_RESOURCE
  refuse(m, "a table that is not there");
  callbacks->freeMemory(m);
  return NULL;
#endif
#ifdef PYTHON
  extern int PyRun_SimpleString(const char *), PyGILState_Ensure(void);
  extern void PyGILState_Release(int);
  const int held = PyGILState_Ensure(), failed = PyRun_SimpleString("import numpy");
  PyGILState_Release(held);
  if (failed) {
    callbacks->freeMemory(m);
    return NULL;
  }
#endif
#ifdef ROUNDS_UP
  fesetround(FE_UPWARD);
  feenableexcept(FE_INVALID | FE_DIVBYZERO);
#endif
#ifdef GOES_AWAY
  if (chdir("/")) return NULL;
#endif
  return m;
}

void fmi2FreeInstance(fmi2Component c) {
  oscillator *m = c;
#ifdef ENDLESS
  m->callbacks.logger(m->callbacks.componentEnvironment, "stranger", fmi2OK, "logEvents", "freed");
#endif
  m->callbacks.freeMemory(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
  for (size_t i = 0; i < n; i++)
    if (strcmp(categories[i], "logStatusError") == 0) ((oscillator *)c)->tells = on;
  return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranced, double tolerance, double start, fmi2Boolean stops,
                               double stop) {
  ONLY(MADE, "fmi2SetupExperiment");
  return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
  ONLY(MADE, "fmi2EnterInitializationMode");
  ((oscillator *)c)->mode = INITIALIZING;
  return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
  oscillator *m = c;
  ONLY(INITIALIZING, "fmi2ExitInitializationMode");
#ifdef INITIAL_EQUATION
  m->v = -0.5 * m->k;
#endif
  m->mode = EVENT;
  return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) {
  ONLY(EVENT | CONTINUOUS, "fmi2Terminate");
#ifdef ENDLESS
  return refuse(c, "the end");
#endif
  return fmi2OK;
}

fmi2Status fmi2EnterEventMode(fmi2Component c) {
  ONLY(CONTINUOUS, "fmi2EnterEventMode");
  ((oscillator *)c)->mode = EVENT;
  return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
  ONLY(EVENT, "fmi2NewDiscreteStates");
  *info = (fmi2EventInfo){0};
  return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
  ONLY(EVENT, "fmi2EnterContinuousTimeMode");
  ((oscillator *)c)->mode = CONTINUOUS;
  return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean keep, fmi2Boolean *event, fmi2Boolean *end) {
  ONLY(CONTINUOUS, "fmi2CompletedIntegratorStep");
  *event = *end = fmi2False;
  return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, double t) {
  ONLY(EVENT | CONTINUOUS, "fmi2SetTime");
  return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const double x[], size_t n) {
  ONLY(CONTINUOUS, "fmi2SetContinuousStates");
  ((oscillator *)c)->x = x[0], ((oscillator *)c)->v = x[1];
  return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, double x[], size_t n) {
  ONLY(INITIALIZING | EVENT | CONTINUOUS, "fmi2GetContinuousStates");
  x[0] = ((oscillator *)c)->x, x[1] = ((oscillator *)c)->v;
  return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, double x[], size_t n) {
  x[0] = x[1] = 1.0;
  return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, double z[], size_t n) { return fmi2OK; }

static double acceleration(const oscillator *m) { return -m->k * m->x - m->c * m->v + m->force + m->sampled; }

fmi2Status fmi2GetDerivatives(fmi2Component c, double dx[], size_t n) {
  ONLY(INITIALIZING | EVENT | CONTINUOUS, "fmi2GetDerivatives");
#ifdef TIRES
  if (((oscillator *)c)->evaluations++ >= 40) return fmi2Discard;
#endif
  dx[0] = ((oscillator *)c)->v, dx[1] = acceleration(c);
  return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference references[], size_t n, double values[]) {
  const oscillator *m = c;
  ONLY(INITIALIZING | EVENT | CONTINUOUS, "fmi2GetReal");
#ifdef NO_VALUES
  return refuse(c, "any value");
#endif
  for (size_t i = 0; i < n; i++) switch (references[i]) {
      case X: values[i] = m->x; break;
      case V: values[i] = m->v; break;
      case DER_V: values[i] = acceleration(m); break;
      case FORCE: values[i] = m->force; break;
      case SAMPLED: values[i] = m->sampled; break;
      case K: values[i] = m->k; break;
      case C: values[i] = m->c; break;
      case ENERGY: values[i] = (m->k * m->x * m->x + m->v * m->v) / 2; break;
      default: return refuse(c, "a variable that is not there");
    }
  return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference references[], size_t n, const double values[]) {
  oscillator *m = c;
  ONLY(MADE | INITIALIZING | EVENT | CONTINUOUS, "fmi2SetReal");
  for (size_t i = 0; i < n; i++) {
    if (references[i] == FORCE) {
      m->force = values[i];
      continue;
    }
    ONLY(MADE | INITIALIZING | EVENT, "setting a parameter, state or discrete input");
    switch (references[i]) {
      case SAMPLED: m->sampled = values[i]; break;
      case K: m->k = values[i]; break;
      case C: m->c = values[i]; break;
      case X: ONLY(MADE | INITIALIZING, "setting a state"); m->x = values[i]; break;
#ifndef INITIAL_EQUATION
      case V: ONLY(MADE | INITIALIZING, "setting a state"); m->v = values[i]; break;
#endif
      default: return refuse(c, "setting this variable");
    }
  }
  return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t rows,
                                        const fmi2ValueReference knowns[], size_t columns, const double seed[],
                                        double values[]) {
  const oscillator *m = c;
  double x = 0.0, v = 0.0, force = 0.0;
  ONLY(INITIALIZING | EVENT | CONTINUOUS, "fmi2GetDirectionalDerivative");
  for (size_t j = 0; j < columns; j++) switch (knowns[j]) { /* the standard has states and continuous inputs */
      case X: x += seed[j]; break;
      case V: v += seed[j]; break;
      case FORCE: force += seed[j]; break;
      default: return refuse(c, "a derivative by this variable");
    }
  for (size_t i = 0; i < rows; i++) switch (unknowns[i]) {
      case X: values[i] = x; break;
      case V: values[i] = v; break;
      case DER_V: values[i] = -m->k * x - m->c * v + force; break;
      default: return refuse(c, "the derivative of this variable");
    }
  return fmi2OK;
}

/* What a library has to export without offering it. */
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

#define MISSING(name, ...) \
  fmi2Status name(fmi2Component c, __VA_ARGS__) { return refuse(c, #name); }
#define VALUES(type) const fmi2ValueReference references[], size_t n, type values[]
MISSING(fmi2GetInteger, VALUES(fmi2Integer))
MISSING(fmi2SetInteger, VALUES(const fmi2Integer))
MISSING(fmi2GetBoolean, VALUES(fmi2Boolean))
MISSING(fmi2SetBoolean, VALUES(const fmi2Boolean))
MISSING(fmi2GetString, VALUES(fmi2String))
MISSING(fmi2SetString, VALUES(const fmi2String))
MISSING(fmi2GetFMUstate, fmi2FMUstate *state)
MISSING(fmi2SetFMUstate, fmi2FMUstate state)
MISSING(fmi2FreeFMUstate, fmi2FMUstate *state)
MISSING(fmi2SerializedFMUstateSize, fmi2FMUstate state, size_t *n)
MISSING(fmi2SerializeFMUstate, fmi2FMUstate state, fmi2Byte bytes[], size_t n)
MISSING(fmi2DeSerializeFMUstate, const fmi2Byte bytes[], size_t n, fmi2FMUstate *state)
fmi2Status fmi2Reset(fmi2Component c) { return refuse(c, "fmi2Reset"); }
