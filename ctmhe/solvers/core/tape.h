/* A function of scalar expressions as a tape of instructions, run for several slots at once: what evaluates a model
 * that no compiler has seen. Each register holds one value a slot (lane), so that reading an instruction is paid for
 * once for all of them. */
#ifndef CTMHE_TAPE_H
#define CTMHE_TAPE_H

#include "core.h"

#include <math.h>
#include <string.h>

#define BATCH CTMHE_BATCH

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

typedef ctmhe_call call;

#if defined(__GNUC__)
typedef double lanes_of_doubles __attribute__((vector_size(8 * BATCH), aligned(64), may_alias));
#define WHOLE(target, left, right, expression)            \
  do {                                                    \
    const lanes_of_doubles a = left, b = right;           \
    target = expression;                                  \
    (void)a, (void)b;                                     \
  } while (0)
#else
typedef struct { double lane[BATCH]; } lanes_of_doubles;
#define WHOLE EACH
#endif

#define LANE(v, l) (((double *)&(v))[l])
#define EACH(target, left, right, expression)                 \
  do {                                                        \
    for (int l = 0; l < lanes; l++) {                         \
      const double a = LANE(left, l), b = LANE(right, l);     \
      LANE(target, l) = expression;                           \
      (void)a, (void)b;                                       \
    }                                                         \
  } while (0)

#if defined(__GNUC__)
#define FILL(target, constant) target = (lanes_of_doubles){0.0} + (constant)
#else
#define FILL(target, constant) \
  for (int l = 0; l < BATCH; l++) LANE(target, l) = constant
#endif

/* The arguments of all lanes, one behind the other; idle lanes repeat the first. */
INLINE void take_arguments(lanes_of_doubles *in, const call *calls, int lanes, int count, const int *sizes) {
  for (int j = 0; j < count; j++)
    for (int i = 0; i < sizes[j]; i++, in++)
      for (int l = 0; l < BATCH; l++) LANE(*in, l) = calls[l < lanes ? l : 0].arg[j][i];
}

/* The results to each lane: `counts` of them, at the places `at`; all others are zero. */
INLINE void give_results(lanes_of_doubles *out, const call *calls, int lanes, int results, const int *sizes,
                         const int *counts, const int *at) {
  for (int l = 0; l < lanes; l++)
    for (int j = 0, o = 0; j < results; o += counts[j++]) {
      double *to = calls[l].res[j];
      if (counts[j] < sizes[j]) memset(to, 0, sizeof(double) * (size_t)sizes[j]);
      for (int i = o; i < o + counts[j]; i++) to[at[i]] = LANE(out[i], l);
    }
}

#define OPERATION(name, how, expression) T_##name,
enum operation {
  T_INPUT, T_OUTPUT, T_CONST,
#include "operations.h"
  T_UNKNOWN
};
#undef OPERATION

#if defined(CTMHE_NX) && !defined(CTMHE_TAPE) /* compiled with a model: its functions are there */
static int run_tape(const ctmhe_function *f, const call *calls, int lanes) {
  (void)f, (void)calls, (void)lanes;
  return 1;
}
#else

INLINE int run_instructions(const ctmhe_function *f, const call *calls, int lanes) {
  lanes_of_doubles *r = (lanes_of_doubles *)f->registers;
  const ctmhe_instruction *end = f->tape + f->tape_length;
  for (int j = 0; j < 3; j++)
    for (int l = 0; l < lanes && f->sizes[j]; l++) memset(calls[l].res[j], 0, sizeof(double) * (size_t)f->sizes[j]);
  for (const ctmhe_instruction *i = f->tape; i < end; i++) {
    const int target = i->target, left = i->left, right = i->right;
    switch ((enum operation)i->operation) {
      case T_INPUT: /* argument `left`, element `right` */
        for (int l = 0; l < BATCH; l++) LANE(r[target], l) = calls[l < lanes ? l : 0].arg[left][right];
        break;
      case T_OUTPUT: /* result `target`, element `right` */
        for (int l = 0; l < lanes; l++) calls[l].res[target][right] = LANE(r[left], l);
        break;
      case T_CONST: FILL(r[target], f->constants[left]); break;
#define OPERATION(name, how, expression) \
  case T_##name: how(r[target], r[left], r[right], expression); break;
#include "operations.h"
#undef OPERATION
      default: return 1;
    }
  }
  return 0;
}

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(CTMHE_BASELINE)
__attribute__((target("avx2"))) static int run_avx2(const ctmhe_function *f, const call *calls, int lanes) {
  return run_instructions(f, calls, lanes);
}

static int run_narrow(const ctmhe_function *f, const call *calls, int lanes) {
  return run_instructions(f, calls, lanes);
}

static int run_tape(const ctmhe_function *f, const call *calls, int lanes) {
  return __builtin_cpu_supports("avx2") ? run_avx2(f, calls, lanes) : run_narrow(f, calls, lanes);
}
#else
static int run_tape(const ctmhe_function *f, const call *calls, int lanes) { return run_instructions(f, calls, lanes); }
#endif
#endif

#endif
