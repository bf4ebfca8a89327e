/* Numbers and the gate of Gonzalez's gradient, as liethermo/functions/gradients.py has them, where the reasons stand. */

#ifndef GONZALEZ_H
#define GONZALEZ_H

#include <math.h>

static const double TINY = 1e-290;
static const double NODE = 0.1127016653792583; /* (1 - sqrt(3/5)) / 2, the first of three Gauss nodes on (0, 1) */
static const double EPS = 0x1p-52;
static const double DIFFERENCE_NOISE = 8 * 0x1p-52;
static const double CURVATURE_SWITCH = 1e-6;

/* 0 where |size| <= threshold, 1 from twice that on, linear between. */
static inline double gate(double size, double threshold)
{
    threshold = threshold > TINY ? threshold : TINY;
    size = fabs(size);
    return size >= 2.0 * threshold ? 1.0 : size <= threshold ? 0.0 : size / threshold - 1.0;
}

#endif
