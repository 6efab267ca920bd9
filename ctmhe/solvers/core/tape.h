/* A function of scalar expressions as a tape of instructions, run for several slots at once: what evaluates a model
 * that no compiler has seen. Each register holds one value a slot (lane), so that reading an instruction is paid for
 * once for all of them. */
#ifndef CTMHE_TAPE_H
#define CTMHE_TAPE_H

#include "layout.h"

typedef struct {              /* arguments and results of one step, in the order of CasADi's function */
  const double *arg[9];
  double *res[3];
  double t, h;
} call;

#if defined(__GNUC__)
typedef double lanes_of_doubles __attribute__((vector_size(8 * BATCH), aligned(64), may_alias));
#define BINARY(expression)                                     \
  do {                                                         \
    const lanes_of_doubles a = r[left], b = r[right];          \
    r[target] = expression;                                    \
    (void)b;                                                   \
  } while (0)
#else
typedef struct { double lane[BATCH]; } lanes_of_doubles;
#define BINARY(expression)                                     \
  do {                                                         \
    for (int l = 0; l < BATCH; l++) {                          \
      const double a = ((double *)(r + left))[l], b = ((double *)(r + right))[l]; \
      ((double *)(r + target))[l] = expression;                \
      (void)b;                                                 \
    }                                                          \
  } while (0)
#endif

#define EACH(expression)                                                                        \
  do {                                                                                          \
    for (int l = 0; l < lanes; l++) {                                                           \
      const double a = ((const double *)(r + left))[l], b = ((const double *)(r + right))[l];   \
      ((double *)(r + target))[l] = (expression);                                               \
      (void)b;                                                                                  \
    }                                                                                           \
  } while (0)

/* The operations, in the order of binding.py; `target` = a op b in registers. */
enum operation {
  T_INPUT, T_OUTPUT, T_CONSTANT, T_COPY, T_ADD, T_SUBTRACT, T_MULTIPLY, T_DIVIDE, T_NEGATE, T_SQUARE, T_TWICE, T_INVERSE,
  T_SQRT, T_EXP, T_LOG, T_POWER, T_SIN, T_COS, T_TAN, T_ASIN, T_ACOS, T_ATAN, T_SINH, T_COSH, T_TANH, T_ASINH, T_ACOSH,
  T_ATANH, T_ATAN2, T_ABSOLUTE, T_SIGN, T_COPYSIGN, T_FLOOR, T_CEIL, T_MODULO, T_MINIMUM, T_MAXIMUM, T_LESS, T_LESS_EQUAL,
  T_EQUAL, T_UNEQUAL, T_NOT, T_AND, T_OR, T_IF_ELSE_ZERO, T_ERF, T_LOG1P, T_EXPM1, T_HYPOT, T_REMAINDER
};

INLINE int run_instructions(const ctmhe_function *f, const call *calls, int lanes) {
  lanes_of_doubles *r = (lanes_of_doubles *)f->registers;
  const ctmhe_instruction *end = f->tape + f->tape_length;
  for (const ctmhe_instruction *i = f->tape; i < end; i++) {
    const int target = i->target, left = i->left, right = i->right;
    switch ((enum operation)i->operation) {
      case T_INPUT: /* argument `left`, element `right`; idle lanes repeat the first */
        for (int l = 0; l < BATCH; l++) ((double *)(r + target))[l] = calls[l < lanes ? l : 0].arg[left][right];
        break;
      case T_OUTPUT: /* result `target`, element `right` */
        for (int l = 0; l < lanes; l++) calls[l].res[target][right] = ((double *)(r + left))[l];
        break;
      case T_CONSTANT:
        for (int l = 0; l < BATCH; l++) ((double *)(r + target))[l] = f->constants[left];
        break;
      case T_COPY: r[target] = r[left]; break;
      case T_ADD: BINARY(a + b); break;
      case T_SUBTRACT: BINARY(a - b); break;
      case T_MULTIPLY: BINARY(a * b); break;
      case T_DIVIDE: BINARY(a / b); break;
      case T_NEGATE: BINARY(-a); break;
      case T_SQUARE: BINARY(a * a); break;
      case T_TWICE: BINARY(a + a); break;
      case T_INVERSE: BINARY(1.0 / a); break;
      case T_SQRT: EACH(sqrt(a)); break;
      case T_EXP: EACH(exp(a)); break;
      case T_LOG: EACH(log(a)); break;
      case T_POWER: EACH(pow(a, b)); break;
      case T_SIN: EACH(sin(a)); break;
      case T_COS: EACH(cos(a)); break;
      case T_TAN: EACH(tan(a)); break;
      case T_ASIN: EACH(asin(a)); break;
      case T_ACOS: EACH(acos(a)); break;
      case T_ATAN: EACH(atan(a)); break;
      case T_SINH: EACH(sinh(a)); break;
      case T_COSH: EACH(cosh(a)); break;
      case T_TANH: EACH(tanh(a)); break;
      case T_ASINH: EACH(asinh(a)); break;
      case T_ACOSH: EACH(acosh(a)); break;
      case T_ATANH: EACH(atanh(a)); break;
      case T_ATAN2: EACH(atan2(a, b)); break;
      case T_ABSOLUTE: EACH(fabs(a)); break;
      case T_SIGN: EACH(a < 0.0 ? -1.0 : a > 0.0 ? 1.0 : a); break;
      case T_COPYSIGN: EACH(copysign(a, b)); break;
      case T_FLOOR: EACH(floor(a)); break;
      case T_CEIL: EACH(ceil(a)); break;
      case T_MODULO: EACH(fmod(a, b)); break;
      case T_MINIMUM: EACH(fmin(a, b)); break;
      case T_MAXIMUM: EACH(fmax(a, b)); break;
      case T_LESS: EACH(a < b); break;
      case T_LESS_EQUAL: EACH(a <= b); break;
      case T_EQUAL: EACH(a == b); break;
      case T_UNEQUAL: EACH(a != b); break;
      case T_NOT: EACH(a == 0.0); break;
      case T_AND: EACH(a != 0.0 && b != 0.0); break;
      case T_OR: EACH(a != 0.0 || b != 0.0); break;
      case T_IF_ELSE_ZERO: EACH(a != 0.0 ? b : 0.0); break;
      case T_ERF: EACH(erf(a)); break;
      case T_LOG1P: EACH(log1p(a)); break;
      case T_EXPM1: EACH(expm1(a)); break;
      case T_HYPOT: EACH(hypot(a, b)); break;
      case T_REMAINDER: EACH(remainder(a, b)); break;
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

#undef BINARY
#undef EACH

#endif
