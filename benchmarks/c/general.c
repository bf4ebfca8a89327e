/* A relaxing system on so(3)* whose energy and entropy are not quadratic, with derivatives by hand,

       Pi' = (Pi + rate dH x dS) x dH,   H = sum Pi_i^2 / (2 I_i) + (stiffness / 4) sum Pi_i^4,   S = log(1 + |Pi|^2).

   The discrete gradient of H is Gonzalez's [BFM 4.3]. Compiled as it stands it is the one of liethermo/functions/gradients.py:
   the difference of H is predicted from the gradient at three Gauss nodes, and the defect of that prediction is let
   through where it exceeds rounding. With -DTEXTBOOK it is the formula as printed, which costs one gradient and one
   value and divides rounding noise by |d|^2 when the system comes to rest. */

#include <math.h>

#include "rules.h"

#define N 3

typedef struct {
    double inverse_inertia[N];
    double rate, stiffness;
} Problem;

static inline double dot(const double u[N], const double v[N]) { return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]; }

static inline double energy_of(const Problem *p, const double x[N])
{
    double total = 0.0;
    EACH(i) {
        const double square = x[i] * x[i];
        total += square * (0.5 * p->inverse_inertia[i] + 0.25 * p->stiffness * square);
    }
    return total;
}

static inline void energy_gradient(const Problem *p, const double x[N], double out[N])
{
    EACH(i)
        out[i] = x[i] * (p->inverse_inertia[i] + p->stiffness * x[i] * x[i]);
}

#define DERIVATIVES energy_gradient
#include "predicted.h"

#ifdef TEXTBOOK

static inline void discrete_gradient(const Problem *p, const Start *s, const double x[N], const double low[N],
                                     const double d[N], double out[N])
{
    double z[N], end[N];
    at(x, low, 0.5, d, z);
    at(x, low, 1.0, d, end);
    energy_gradient(p, z, out);
    const double square = dot(d, d);
    const double factor = square > TINY ? (energy_of(p, end) - s->energy - dot(out, d)) / square : 0.0;
    EACH(i)
        out[i] += factor * d[i];
}

#endif

static inline void slopes(const Problem *p, const Start *s, const double x[N], const double low[N], double h,
                          const double k[N], double out[N])
{
    double d[N], z[N], w[N];
    EACH(i)
        d[i] = h * k[i];
    at(x, low, 0.5, d, z);
    discrete_gradient(p, s, x, low, d, w);
    const double b = 2.0 * p->rate / (1.0 + dot(z, z)); /* rate times the factor of grad S(z) = b z */
    const double u0 = z[0] + b * (w[1] * z[2] - w[2] * z[1]);
    const double u1 = z[1] + b * (w[2] * z[0] - w[0] * z[2]);
    const double u2 = z[2] + b * (w[0] * z[1] - w[1] * z[0]);
    out[0] = u1 * w[2] - u2 * w[1];
    out[1] = u2 * w[0] - u0 * w[2];
    out[2] = u0 * w[1] - u1 * w[0];
}

static inline void values(const Problem *p, const double x[N], double *energy, double *entropy)
{
    *energy = energy_of(p, x);
    *entropy = log(1.0 + dot(x, x));
}

#include "midpoint.h"
