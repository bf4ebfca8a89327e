/* Damped spins on a lattice with neighbour lists, exchange J and an easy axis K, by the algorithm of VAMPIRE [Evans et al.
   2014]: Heun's method, after each half of which the lengths are restored,

       s' = -s x B - rate s x (s x B),   B_i = J sum s_j + 2 K s_i3 + amplitude (normal numbers).

   One thread, as VAMPIRE uses for each of its processes. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

typedef struct {
    double exchange, axis, rate, amplitude;
    double neighbours;
} Problem;

typedef struct {
    uint64_t s[4];
} Generator;

/* xoshiro256+ [Blackman & Vigna 2021], in (0, 1). */
static inline double uniform(Generator *g)
{
    const uint64_t result = g->s[0] + g->s[3], t = g->s[1] << 17;
    g->s[2] ^= g->s[0];
    g->s[3] ^= g->s[1];
    g->s[1] ^= g->s[2];
    g->s[0] ^= g->s[3];
    g->s[2] ^= t;
    g->s[3] = (g->s[3] << 45) | (g->s[3] >> 19);
    return ((double)(result >> 11) + 0.5) * 0x1p-53;
}

/* Normal numbers in pairs [Box & Muller 1958]. */
static void normal_numbers(Generator *g, double *out, int64_t count)
{
    for (int64_t i = 0; i < count; i += 2) {
        const double r = sqrt(-2.0 * log(uniform(g))), angle = 6.283185307179586 * uniform(g);
        out[i] = r * cos(angle);
        out[i + 1] = r * sin(angle);
    }
}

/* The velocity of spin i in the state x, with the noise of this step. */
static inline void velocity(const Problem *p, const double *x, const int32_t *list, const double *noise, int64_t i, double v[3])
{
    const int n = (int)p->neighbours;
    const double *s = x + 3 * i;
    double b[3] = {p->amplitude * noise[3 * i], p->amplitude * noise[3 * i + 1],
                   p->amplitude * noise[3 * i + 2] + 2.0 * p->axis * s[2]};
    for (int m = 0; m < n; m++) {
        const double *other = x + 3 * (int64_t)list[n * i + m];
        for (int c = 0; c < 3; c++)
            b[c] += p->exchange * other[c];
    }
    const double t[3] = {s[1] * b[2] - s[2] * b[1], s[2] * b[0] - s[0] * b[2], s[0] * b[1] - s[1] * b[0]};
    v[0] = -t[0] - p->rate * (s[1] * t[2] - s[2] * t[1]);
    v[1] = -t[1] - p->rate * (s[2] * t[0] - s[0] * t[2]);
    v[2] = -t[2] - p->rate * (s[0] * t[1] - s[1] * t[0]);
}

static inline void normalise(double s[3])
{
    const double scale = 1.0 / sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2]);
    for (int c = 0; c < 3; c++)
        s[c] *= scale;
}

void integrate_heun(const Problem *p, double *x, const int32_t *list, int64_t count, double h, int64_t steps)
{
    double *first = malloc(3 * count * sizeof(double)), *predicted = malloc(3 * count * sizeof(double));
    double *noise = calloc(3 * count + 1, sizeof(double));
    Generator g = {{1, 2, 3, 4}};
    for (int64_t step = 0; step < steps; step++) {
        if (p->amplitude != 0.0)
            normal_numbers(&g, noise, 3 * count);
        for (int64_t i = 0; i < count; i++) {
            velocity(p, x, list, noise, i, first + 3 * i);
            for (int c = 0; c < 3; c++)
                predicted[3 * i + c] = x[3 * i + c] + h * first[3 * i + c];
            normalise(predicted + 3 * i);
        }
        for (int64_t i = 0; i < count; i++) {
            double second[3];
            velocity(p, predicted, list, noise, i, second);
            for (int c = 0; c < 3; c++)
                x[3 * i + c] += 0.5 * h * (first[3 * i + c] + second[c]);
            normalise(x + 3 * i);
        }
    }
    free(first);
    free(predicted);
    free(noise);
}
