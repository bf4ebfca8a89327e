/* The variational schemes 1, 2 and 3 [GBY §5.1] for the mass and spring in an ideal gas, in the state (x, v, S):

       L = m v^2 / 2 - k x^2 / 2 - c T0 exp(S / c),   F_fr = -lambda v.

   -DSCHEME says which. V = (x_1 - x_0)/h is known outright; s = (S_1 - S_0)/h, by Newton's method, is what is iterated. */

#undef DRIFT_THRESHOLD
#define DRIFT_THRESHOLD INFINITY /* none of them keeps the energy to rounding */
#include <math.h>

#include "rules.h"

#define N 3

typedef struct {
    double mass, stiffness, friction, heat, temperature;
} Problem;

typedef struct {
    double T0;
} Start;

static inline double temperature(const Problem *p, double S) { return p->temperature * exp(S / p->heat); }

static inline Start start(const Problem *p, const double x[N]) { return (Start){temperature(p, x[2])}; }

static inline void slopes(const Problem *p, const Start *start, const double x[N], const double low[N], double h,
                          const double k[N], double out[N])
{
    const double m = p->mass, lambda = p->friction, q0 = x[0] + low[0], v0 = x[1] + low[1], S0 = x[2] + low[2];
#if SCHEME == 1
    const double V = (m * v0 - h * p->stiffness * q0) / (m + h * lambda);
    const double middle = q0, T = start->T0, slope = T, s = 0.0;
    (void)S0, (void)k;
#elif SCHEME == 2
    const double V = (m * v0 - 0.5 * h * p->stiffness * q0) / (m + 0.25 * h * h * p->stiffness + 0.5 * h * lambda);
    const double middle = q0 + 0.5 * h * V, s = k[2], T = temperature(p, S0 + 0.5 * h * s);
    const double slope = T * (1.0 + 0.5 * h * s / p->heat);
    (void)start;
#else
    const double V = (m * v0 - 0.5 * h * p->stiffness * q0) / (m + 0.5 * h * lambda);
    const double middle = q0 + 0.5 * h * V, s = k[2], T1 = temperature(p, S0 + h * s), T = 0.5 * (start->T0 + T1);
    const double slope = T + 0.5 * h * s * T1 / p->heat;
#endif
    out[0] = V;
    out[1] = -(p->stiffness * middle + lambda * V) / m;
    out[2] = s - (T * s - lambda * V * V) / slope;
}

static inline void values(const Problem *p, const double x[N], double *energy, double *entropy)
{
    *energy = 0.5 * (p->mass * x[1] * x[1] + p->stiffness * x[0] * x[0]) + p->heat * temperature(p, x[2]);
    *entropy = x[2];
}

static inline void energy_gradient(const Problem *p, const double x[N], double out[N])
{
    (void)p, (void)x;
    EACH(i)
        out[i] = 0.0;
}

#include "midpoint.h"
