/* When to stop iterating, and when to steer the energy: the rules of liethermo/engines/array.py, where the reasons stand. */

#ifndef RULES_H
#define RULES_H

#include <float.h>

#define FIXED_POINT_LIMIT 60
#define SLOW 0.6
#define SHRINKING 0.8
#define FLOOR (1e-5 * DBL_EPSILON)
#define PLATEAU (1e3 * DBL_EPSILON)
#ifndef STEERED
#define STEERED (4 * DBL_EPSILON)
#endif

enum { RUNNING, NOT_CONVERGED, NON_FINITE };

/* A loop over components, unrolled: there are too few for GCC's vectoriser, whose code takes a fifth longer. */
#define EACH(i) _Pragma("GCC unroll 8") for (int i = 0; i < N; i++)

#endif
