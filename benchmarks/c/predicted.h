/* Gonzalez's discrete gradient [BFM 4.3], as in liethermo/functions/gradients.py: the difference of H is predicted from
   the gradient at three Gauss nodes, and the defect of that prediction is let through where it exceeds rounding. A
   program defines `dot`, `energy_of` and DERIVATIVES, the function that makes the gradient. */

#include "gonzalez.h"

typedef struct {
    double energy, size;
} Start;

static inline Start start(const Problem *p, const double x[N])
{
    return (Start){.energy = energy_of(p, x), .size = sqrt(dot(x, x))};
}

static inline void at(const double x[N], const double low[N], double c, const double d[N], double out[N])
{
    EACH(i)
        out[i] = x[i] + (low[i] + c * d[i]);
}

#ifndef TEXTBOOK

static inline void discrete_gradient(const Problem *p, const Start *s, const double x[N], const double low[N],
                                     const double d[N], double out[N])
{
    double point[N], left[N], middle[N], right[N];
    at(x, low, NODE, d, point);
    DERIVATIVES(p, point, left);
    at(x, low, 0.5, d, point);
    DERIVATIVES(p, point, middle);
    at(x, low, 1.0 - NODE, d, point);
    DERIVATIVES(p, point, right);
    at(x, low, 1.0, d, point);
    const double end = energy_of(p, point);

    double second = 0.0, left_out = 0.0; /* what the values at x and at the end leave out */
    EACH(i) {
        const double back = point[i] - x[i], whole = low[i] + d[i];
        left_out += middle[i] * ((x[i] - (point[i] - back)) + (whole - back) - low[i]);
        second += (left[i] + right[i] - 2.0 * middle[i]) * d[i];
    }
    const double square = dot(d, d), slope = sqrt(dot(middle, middle));
    double defect = (end - s->energy) + left_out - (dot(middle, d) + (5.0 / 18.0) * second);
    double opened = gate(second, CURVATURE_SWITCH * slope * sqrt(square));
    if (opened < 1.0) {
        const double noise = DIFFERENCE_NOISE * (fabs(s->energy) + fabs(end)) + 4.0 * EPS * slope * s->size;
        const double by_size = gate(defect, noise);
        opened = by_size > opened ? by_size : opened;
    }
    defect *= opened;
    const double factor = square > TINY ? ((5.0 / 18.0) * second + defect) / square : 0.0;
    EACH(i)
        out[i] = middle[i] + factor * d[i];
}

#endif
