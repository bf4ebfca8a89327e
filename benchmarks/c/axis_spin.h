/* A spin s with a bath of entropy S: its energy, and the derivatives of that by hand,

       H = -a (s_3^2/2 + s_3^4/4) - b . s + exp(S). */

#include <math.h>

#define N 4

typedef struct {
    double axis, field[3], rate;
} Problem;

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
