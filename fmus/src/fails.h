/* The trap `fails`: evaluating with the first state above `limit` fails as `failure` says. An importer should try
 * another point after 1 and 3, make a new instance after 2, and run what may do 4 and 5 in a process of its own. */
#ifndef CTMHE_FAILS_H
#define CTMHE_FAILS_H

#include <math.h>
#include <stdlib.h>

#include "core.h"

static CoreStatus fail(Core *core, const double x[], double dx[]) {
    const double *p = core->values.v + VR_P;
    volatile int forever = 1;
    if (!(x[0] > p[P_limit])) return CORE_OK;
    switch ((int)p[P_failure]) {
    case 1: return CORE_DISCARDED;
    case 2: core->broken = 1; return CORE_BROKEN;
    case 3: dx[NX - 1] = NAN; return CORE_OK;
    case 4: abort();
    case 5: while (forever) continue;
    }
    return CORE_OK;
}

#endif
