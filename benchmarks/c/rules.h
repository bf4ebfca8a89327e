/* When to stop iterating, and when to steer the energy: the rules come from liethermo/engines/solver_options.py, as definitions
   on the command line. */

#ifndef RULES_H
#define RULES_H

#include <float.h>

enum { RUNNING, NOT_CONVERGED, NON_FINITE };

/* A loop over components, unrolled: there are too few for GCC's vectoriser, whose code takes a fifth longer. */
#define EACH(i) _Pragma("GCC unroll 8") for (int i = 0; i < N; i++)

#endif
