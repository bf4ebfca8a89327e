/* A spin s on S^2 with a bath of entropy S, with derivatives by hand,

       H = -a (s_3^2/2 + s_3^4/4) - b . s + exp(S),   s' = s x dH + K dS,   K(dS) = rate (|dH|^2 dS - (dH . dS) dH),

   by the midpoint scheme in the space around the sphere: every sphere is an invariant of it, and the end of a step is
   brought back by what rounding has moved it. Gonzalez's gradient is that of predicted.h. */

#include "axis_spin.h"
#include "rules.h"

#define OWN_MOVE
#define DERIVATIVES derivatives
#include "predicted.h"

/* What of the derivatives is along the spheres. */
static inline void energy_gradient(const Problem *p, const double x[N], double out[N])
{
    derivatives(p, x, out);
    const double off = dot3(x, out) / dot3(x, x);
    SPIN(i)
        out[i] -= off * x[i];
}

static inline void slopes(const Problem *p, const Start *s, const double x[N], const double low[N], double h,
                          const double k[N], double out[N])
{
    double d[N], z[N], w[N], raised[N];
    EACH(i)
        d[i] = h * k[i];
    at(x, low, 0.5, d, z);
    discrete_gradient(p, s, x, low, d, w);
    const double square = dot3(z, z), off = dot3(z, w);
    SPIN(i)
        raised[i] = square * w[i] - off * z[i]; /* along every sphere */
    const double heat = dot3(w, raised) + w[3] * w[3];
    out[0] = z[1] * w[2] - z[2] * w[1] - p->rate * w[3] * raised[0];
    out[1] = z[2] * w[0] - z[0] * w[2] - p->rate * w[3] * raised[1];
    out[2] = z[0] * w[1] - z[1] * w[0] - p->rate * w[3] * raised[2];
    out[3] = p->rate * (heat - w[3] * w[3]);
}

/* Neumaier's two-sum, and then what rounding has moved the spin off its sphere by, once that is more than noise. */
static inline void move(const Problem *p, const double x[N], const double low[N], double h, const double k[N],
                        double new[N], double new_low[N])
{
    (void)p;
    EACH(i) {
        const double increment = h * k[i] + low[i];
        new[i] = x[i] + increment;
        const double back = new[i] - x[i];
        new_low[i] = (x[i] - (new[i] - back)) + (increment - back);
    }
    const double square = dot3(new, new), off = 0.5 * (square - 1.0) + dot3(new, new_low);
    if (fabs(off) > 4.0 * EPS * square) {
        const double most = 8.0 * EPS * square;
        const double taken = (off > most ? most : off < -most ? -most : off) / square;
        SPIN(i)
            new_low[i] -= taken * new[i];
    }
}

static inline void values(const Problem *p, const double x[N], double *energy, double *entropy)
{
    *energy = energy_of(p, x);
    *entropy = x[3];
}

#include "midpoint.h"
