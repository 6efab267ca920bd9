/* The FMI functions that an evaluator calls, for both versions of the standard. */
#ifndef CTMHE_CALLS_H
#define CTMHE_CALLS_H

#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu.h"

#ifdef _WIN32
#include <windows.h>
typedef HMODULE library_handle;
#else
#include <dlfcn.h>
typedef void *library_handle;
#endif

enum { FMI_OK, FMI_WARNING, FMI_DISCARD, FMI_ERROR, FMI_FATAL, FMI_PENDING };

typedef void *instance;
typedef void *saved_state;

typedef struct {
  void (*log)(void *, const char *, int, const char *, const char *, ...);
  void *(*allocate)(size_t, size_t);
  void (*release)(void *);
  void (*finished)(void *, int);
  void *environment;
} callbacks2;

typedef struct {
  int again, terminate, nominals, states, planned;
  double next;
} event_info2;

typedef void (*log3)(void *, int, const char *, const char *);

/* Names without a version are called the same way in both. */
typedef struct {
  instance (*instantiate2)(const char *, int, const char *, const char *, const callbacks2 *, int, int);
  instance (*instantiate_exchange3)(const char *, const char *, const char *, bool, bool, void *, log3);
  instance (*instantiate_simulation3)(const char *, const char *, const char *, bool, bool, bool, bool,
                                      const uint32_t *, size_t, void *, log3, void *);
  void (*release)(instance);
  int (*debug2)(instance, int, size_t, const char *const *);
  int (*debug3)(instance, bool, size_t, const char *const *);
  int (*setup2)(instance, int, double, double, int, double);
  int (*enter_initialization2)(instance);
  int (*enter_initialization3)(instance, bool, double, double, bool, double);
  int (*exit_initialization)(instance);
  int (*enter_events)(instance);
  int (*enter_continuous)(instance);
  int (*discrete2)(instance, event_info2 *);
  int (*discrete3)(instance, bool *, bool *, bool *, bool *, bool *, double *);
  int (*set_time)(instance, double);
  int (*set_states)(instance, const double *, size_t);
  int (*derivatives)(instance, double *, size_t);
  int (*set2)(instance, const uint32_t *, size_t, const double *);
  int (*set3)(instance, const uint32_t *, size_t, const double *, size_t);
  int (*get2)(instance, const uint32_t *, size_t, double *);
  int (*get3)(instance, const uint32_t *, size_t, double *, size_t);
  int (*directional2)(instance, const uint32_t *, size_t, const uint32_t *, size_t, const double *, double *);
  int (*directional3)(instance, const uint32_t *, size_t, const uint32_t *, size_t, const double *, size_t, double *,
                      size_t);
  int (*save)(instance, saved_state *);
  int (*load)(instance, saved_state);
  int (*forget)(instance, saved_state *);
  int (*step2)(instance, double, double, int);
  int (*step3)(instance, double, double, bool, bool *, bool *, bool *, double *);
} functions;

static library_handle open_library(const char *path, char *message, size_t size) {
#ifdef _WIN32
  library_handle handle = LoadLibraryA(path);
  if (!handle) snprintf(message, size, "error %lu of LoadLibrary", GetLastError());
#else
  library_handle handle = dlopen(path, RTLD_NOW | RTLD_LOCAL);
  if (!handle) snprintf(message, size, "%s", dlerror());
#endif
  return handle;
}

static void close_library(library_handle handle) {
#ifdef _WIN32
  FreeLibrary(handle);
#else
  dlclose(handle);
#endif
}

static void find(library_handle handle, const char *name, void *target) {
#ifdef _WIN32
  void *found = (void *)GetProcAddress(handle, name);
#else
  void *found = dlsym(handle, name);
#endif
  memcpy(target, &found, sizeof found);
}

/* Look all functions up; returns the name of a missing one that is needed, or NULL. */
static const char *find_functions(library_handle handle, int version, int co_simulation, functions *f) {
  const char *missing = NULL;
  memset(f, 0, sizeof *f);
#define FIND(field, name) find(handle, name, &f->field)
#define NEED(field, name) do { FIND(field, name); if (!f->field) missing = name; } while (0)
  if (version == 2) {
    NEED(instantiate2, "fmi2Instantiate");
    NEED(release, "fmi2FreeInstance");
    FIND(debug2, "fmi2SetDebugLogging");
    NEED(setup2, "fmi2SetupExperiment");
    NEED(enter_initialization2, "fmi2EnterInitializationMode");
    NEED(exit_initialization, "fmi2ExitInitializationMode");
    NEED(set2, "fmi2SetReal");
    NEED(get2, "fmi2GetReal");
    FIND(directional2, "fmi2GetDirectionalDerivative");
    FIND(save, "fmi2GetFMUstate");
    FIND(load, "fmi2SetFMUstate");
    FIND(forget, "fmi2FreeFMUstate");
    if (co_simulation) {
      NEED(step2, "fmi2DoStep");
    } else {
      NEED(enter_events, "fmi2EnterEventMode");
      NEED(enter_continuous, "fmi2EnterContinuousTimeMode");
      NEED(discrete2, "fmi2NewDiscreteStates");
      NEED(set_time, "fmi2SetTime");
      NEED(set_states, "fmi2SetContinuousStates");
      NEED(derivatives, "fmi2GetDerivatives");
    }
  } else {
    NEED(release, "fmi3FreeInstance");
    FIND(debug3, "fmi3SetDebugLogging");
    NEED(enter_initialization3, "fmi3EnterInitializationMode");
    NEED(exit_initialization, "fmi3ExitInitializationMode");
    NEED(set3, "fmi3SetFloat64");
    NEED(get3, "fmi3GetFloat64");
    FIND(directional3, "fmi3GetDirectionalDerivative");
    FIND(save, "fmi3GetFMUState");
    FIND(load, "fmi3SetFMUState");
    FIND(forget, "fmi3FreeFMUState");
    if (co_simulation) {
      NEED(instantiate_simulation3, "fmi3InstantiateCoSimulation");
      NEED(step3, "fmi3DoStep");
    } else {
      NEED(instantiate_exchange3, "fmi3InstantiateModelExchange");
      NEED(enter_events, "fmi3EnterEventMode");
      NEED(enter_continuous, "fmi3EnterContinuousTimeMode");
      NEED(discrete3, "fmi3UpdateDiscreteStates");
      NEED(set_time, "fmi3SetTime");
      NEED(set_states, "fmi3SetContinuousStates");
      NEED(derivatives, "fmi3GetContinuousStateDerivatives");
    }
  }
#undef NEED
#undef FIND
  return missing;
}

#endif
