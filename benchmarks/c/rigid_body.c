/* One relaxed rigid body [BFM Example 3.2]: quadratic energy and entropy,

       Pi' = (Pi + rate Omega x Pi) x Omega,   Omega_i = Pi_i / I_i,   H = Pi.Omega / 2,   S = |Pi|^2 / 2.

   For a quadratic energy the discrete gradient is the gradient at the midpoint. */

#include "rules.h"

#define N 3

typedef struct {
    double inverse_inertia[N];
    double rate;
} Problem;

typedef struct {
    int nothing;
} Start;

static inline Start start(const Problem *p, const double x[N])
{
    (void)p, (void)x;
    return (Start){0};
}

static inline void slopes(const Problem *p, const Start *s, const double x[N], const double low[N], double h,
                          const double k[N], double out[N])
{
    (void)s;
    double z[N], w[N];
    EACH(i) {
        z[i] = x[i] + (low[i] + 0.5 * h * k[i]);
        w[i] = p->inverse_inertia[i] * z[i];
    }
    const double u0 = z[0] + p->rate * (w[1] * z[2] - w[2] * z[1]);
    const double u1 = z[1] + p->rate * (w[2] * z[0] - w[0] * z[2]);
    const double u2 = z[2] + p->rate * (w[0] * z[1] - w[1] * z[0]);
    out[0] = u1 * w[2] - u2 * w[1];
    out[1] = u2 * w[0] - u0 * w[2];
    out[2] = u0 * w[1] - u1 * w[0];
}

static inline void values(const Problem *p, const double x[N], double *energy, double *entropy)
{
    const double *a = p->inverse_inertia;
    *energy = 0.5 * (a[0] * x[0] * x[0] + a[1] * x[1] * x[1] + a[2] * x[2] * x[2]);
    *entropy = 0.5 * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
}

static inline void energy_gradient(const Problem *p, const double x[N], double out[N])
{
    EACH(i)
        out[i] = p->inverse_inertia[i] * x[i];
}

#include "midpoint.h"
