/* A ring of spins with exchange J and an easy axis K, damped, with a bath of entropy y, heat capacity c and U = c exp(y/c),

       H = -sum J s_i . s_(i+1) - sum K s_i3^2 + U(y),   s' = s x dH + rate s x (s x dH),   y' = rate sum |s x dH|^2 / T,

   by the midpoint scheme [BFM 4.5]: the spins' part of H is quadratic, so its gradient at the midpoint is a discrete one,
   and T is the difference quotient of U. One pass over the memory for each iteration, in as many threads as are asked
   for. Sizes are root mean squares, as the library's are of large systems. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "rules.h"

typedef struct {
    double exchange, axis, rate, capacity;
} Problem;

typedef struct {
    double energy, entropy, first_energy, largest_energy, smallest_energy, least_entropy_increment;
    int64_t status, steps, iterations;
} Record;

typedef struct {
    int64_t count;
    double *x, *low, *k, *before, *new;
} State;

static inline double bath(const Problem *p, double y) { return p->capacity * exp(y / p->capacity); }

/* dH of the spin in the middle of three. */
static inline void field(const Problem *p, const double *left, const double *z, const double *right, double a[3])
{
    for (int c = 0; c < 3; c++)
        a[c] = -p->exchange * (left[c] + right[c]);
    a[2] -= 2.0 * p->axis * z[2];
}

/* new = slopes(k); the squares of new - k and of new, summed. */
static void slopes(const Problem *p, const State *s, double h, double *update, double *size)
{
    const int64_t n = s->count;
    const double *x = s->x, *low = s->low, *k = s->k;
    double *new = s->new, heat = 0.0, changed = 0.0, square = 0.0;
#pragma omp parallel for reduction(+ : heat, changed, square)
    for (int64_t i = 0; i < n; i++) {
        const int64_t at[3] = {3 * (i ? i - 1 : n - 1), 3 * i, 3 * (i + 1 < n ? i + 1 : 0)};
        double z[3][3], a[3];
        for (int j = 0; j < 3; j++)
            for (int c = 0; c < 3; c++)
                z[j][c] = x[at[j] + c] + (low[at[j] + c] + 0.5 * h * k[at[j] + c]);
        const double *m = z[1];
        field(p, z[0], m, z[2], a);
        const double t[3] = {m[1] * a[2] - m[2] * a[1], m[2] * a[0] - m[0] * a[2], m[0] * a[1] - m[1] * a[0]};
        const double out[3] = {t[0] + p->rate * (m[1] * t[2] - m[2] * t[1]), t[1] + p->rate * (m[2] * t[0] - m[0] * t[2]),
                               t[2] + p->rate * (m[0] * t[1] - m[1] * t[0])};
        heat += t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
        for (int c = 0; c < 3; c++) {
            const double change = out[c] - k[3 * i + c];
            changed += change * change;
            square += out[c] * out[c];
            new[3 * i + c] = out[c];
        }
    }
    const double y = x[3 * n] + low[3 * n], d = h * k[3 * n];
    const double T = d != 0.0 ? bath(p, y) * expm1(d / p->capacity) / d : bath(p, y) / p->capacity;
    new[3 * n] = p->rate * heat / T;
    changed += (new[3 * n] - k[3 * n]) * (new[3 * n] - k[3 * n]);
    *update = sqrt(changed / (3 * n + 1));
    *size = sqrt((square + new[3 * n] * new[3 * n]) / (3 * n + 1));
}

static int solve(const Problem *p, State *s, double h, int64_t *iterations)
{
    const int64_t n = 3 * s->count + 1;
    double square = 0.0, best = INFINITY;
#pragma omp parallel for reduction(+ : square)
    for (int64_t i = 0; i < n; i++) {
        square += s->x[i] * s->x[i];
        const double guess = 2.0 * s->k[i] - s->before[i];
        s->before[i] = s->k[i];
        s->k[i] = guess;
    }
    const double whole = sqrt(square / n) / h;
    for (int made = 1, stalled = 0; made <= MAX_FIXED_POINT_ITERATIONS; made++) {
        double update, size, *old = s->k;
        slopes(p, s, h, &update, &size);
        s->k = s->new;
        s->new = old;
        *iterations += 1;
        if (!isfinite(update))
            return NON_FINITE;
        stalled = update < STALL_RATIO * best ? 0 : stalled + 1;
        best = fmin(update, best);
        if (update <= UPDATE_FLOOR * (whole + size) || (stalled >= 2 && update <= PLATEAU_RTOL * (whole + size)))
            return RUNNING;
    }
    return NOT_CONVERGED;
}

/* x + low moved by h k; the energy there, and where it is off by more than a few roundings of itself, steered back. */
static void finish(const Problem *p, State *s, double h, Record *r)
{
    const int64_t n = s->count, whole = 3 * n + 1;
    double *x = s->x, *low = s->low, spins = 0.0, gradient = 0.0, square = 0.0, along = 0.0;
#pragma omp parallel for
    for (int64_t i = 0; i < whole; i++) {
        const double d = h * s->k[i] + low[i], new = x[i] + d, back = new - x[i];
        low[i] = (x[i] - (new - back)) + (d - back);
        x[i] = new;
    }
#pragma omp parallel for reduction(+ : spins, gradient, square, along)
    for (int64_t i = 0; i < n; i++) {
        double a[3];
        field(p, x + 3 * (i ? i - 1 : n - 1), x + 3 * i, x + 3 * (i + 1 < n ? i + 1 : 0), a);
        for (int c = 0; c < 3; c++) {
            spins += 0.5 * a[c] * x[3 * i + c];
            gradient += a[c] * a[c];
            square += x[3 * i + c] * x[3 * i + c];
            along += a[c] * low[3 * i + c];
        }
    }
    const double y = x[3 * n], T = bath(p, y) / p->capacity;
    const double energy = spins + bath(p, y), error = energy - r->first_energy + along + T * low[3 * n];
    gradient += T * T;
    const double size = sqrt(gradient) * sqrt(square + y * y);
    if (fabs(error) > DRIFT_THRESHOLD * fmax(fabs(r->first_energy), size)) {
        const double most = 0.25 * DBL_EPSILON * size, share = fmax(-most, fmin(error, most)) / gradient;
#pragma omp parallel for
        for (int64_t i = 0; i < n; i++) {
            double a[3];
            field(p, x + 3 * (i ? i - 1 : n - 1), x + 3 * i, x + 3 * (i + 1 < n ? i + 1 : 0), a);
            for (int c = 0; c < 3; c++)
                low[3 * i + c] -= share * a[c];
        }
        low[3 * n] -= share * T;
    }
    r->least_entropy_increment = fmin(r->least_entropy_increment, y - r->entropy);
    r->largest_energy = fmax(r->largest_energy, energy);
    r->smallest_energy = fmin(r->smallest_energy, energy);
    r->energy = energy;
    r->entropy = y;
}

/* `steps` steps of size h from x, shape (3 count + 1,), in place. */
void integrate_ring(const Problem *p, double *x, int64_t count, double h, int64_t steps, Record *record)
{
    const size_t size = (3 * count + 1) * sizeof(double);
    State s = {count, x, calloc(1, size), calloc(1, size), malloc(size), malloc(size)};
    Record r = {.least_entropy_increment = INFINITY, .largest_energy = -INFINITY, .smallest_energy = INFINITY};
    double unused[2];
    slopes(p, &s, 0.0, unused, unused + 1); /* a step of nothing has the vector field for its slope */
    memcpy(s.k, s.new, size);
    memcpy(s.before, s.new, size);
    r.entropy = x[3 * count];
    double *k = s.k;
    s.k = s.low; /* zeros: the energy of the start */
    finish(p, &s, 0.0, &r);
    s.k = k;
    r.first_energy = r.largest_energy = r.smallest_energy = r.energy;
    r.least_entropy_increment = INFINITY;
    memset(s.low, 0, size);
    while (r.steps < steps && r.status == RUNNING) {
        r.status = solve(p, &s, h, &r.iterations);
        if (r.status == RUNNING) {
            finish(p, &s, h, &r);
            r.steps += 1;
        }
    }
    *record = r;
    free(s.low), free(s.k), free(s.before), free(s.new);
}
