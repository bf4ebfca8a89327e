/* A spin s on S^2 with a bath of entropy S, with derivatives by hand,

       H = -a (s_3^2/2 + s_3^4/4) - b . s + exp(S),   s' = s x dH + K dS,   K(dS) = rate (|dH|^2 dS - (dH . dS) dH),

   by the midpoint scheme in the space around the sphere: every sphere is an invariant of it, and the end of a step is
   brought back by what rounding has moved it. Gonzalez's gradient is that of general.c. */

#include <math.h>

#include "gonzalez.h"
#include "rules.h"

#define N 4
#define OWN_MOVE

typedef struct {
    double axis, field[3], rate;
} Problem;

typedef struct {
    double energy, size;
} Start;

#define SPIN(i) _Pragma("GCC unroll 3") for (int i = 0; i < 3; i++)

static inline double dot3(const double u[N], const double v[N]) { return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]; }
static inline double dot(const double u[N], const double v[N]) { return dot3(u, v) + u[3] * v[3]; }

static inline double energy_of(const Problem *p, const double x[N])
{
    const double square = x[2] * x[2];
    return exp(x[3]) - p->axis * square * (0.5 + 0.25 * square) - dot3(p->field, x);
}

static inline void derivatives(const Problem *p, const double x[N], double out[N])
{
    SPIN(i)
        out[i] = -p->field[i];
    out[2] -= p->axis * x[2] * (1.0 + x[2] * x[2]);
    out[3] = exp(x[3]);
}

/* What of the derivatives is along the spheres. */
static inline void energy_gradient(const Problem *p, const double x[N], double out[N])
{
    derivatives(p, x, out);
    const double off = dot3(x, out) / dot3(x, x);
    SPIN(i)
        out[i] -= off * x[i];
}

static inline Start start(const Problem *p, const double x[N])
{
    return (Start){.energy = energy_of(p, x), .size = sqrt(dot(x, x))};
}

static inline void at(const double x[N], const double low[N], double c, const double d[N], double out[N])
{
    EACH(i)
        out[i] = x[i] + (low[i] + c * d[i]);
}

static inline void discrete_gradient(const Problem *p, const Start *s, const double x[N], const double low[N],
                                     const double d[N], double out[N])
{
    double point[N], left[N], middle[N], right[N];
    at(x, low, NODE, d, point);
    derivatives(p, point, left);
    at(x, low, 0.5, d, point);
    derivatives(p, point, middle);
    at(x, low, 1.0 - NODE, d, point);
    derivatives(p, point, right);
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
