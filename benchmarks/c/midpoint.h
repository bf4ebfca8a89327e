/* Step loop of the metriplectic midpoint scheme [BFM 4.5] for one system of N components.

   A file that includes this one first defines

       N                                     the number of components,
       Problem                               the parameters of the system,
       Start, start(p, x)                    what the slopes need of the state and what does not change in a step,
       slopes(p, s, x, low, h, k, out)       the right-hand side of  k = slopes(k),
       values(p, x, &energy, &entropy),
       energy_gradient(p, x, out),

   and, with OWN_MOVE, on a manifold, move(p, x, low, h, k, new, new_low).

   A step solves k = slopes(k) by fixed-point iteration from 2 k - before, down to the rounding plateau, and adds h k
   with compensated summation; what rounding has done to the energy is steered back. The iteration is that of
   liethermo/engines/compiled/step_loop.py without Newton's method: where the library would turn to that, this run ends. */

#include <math.h>
#include <stdint.h>

#include "rules.h"

typedef struct {
    double x[N], low[N], k[N], before[N];
    double energy, entropy;
    double first_energy, largest_energy, smallest_energy;
    double least_entropy_increment, largest_energy_increment;
    double residual, worst_residual, integral;
    int64_t status, steps, iterations, most_iterations;
} Run;

static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double smaller(double a, double b) { return a < b ? a : b; }

static inline double largest_of(const double v[N])
{
    double largest = 0.0;
    EACH(i)
        largest = larger(largest, fabs(v[i]));
    return largest;
}

/* Solve the step equations from the guess in k, in place; returns a status. */
static inline int solve(const Problem *p, const Run *run, double h, double k[N], double *update, int *iterations)
{
    const Start s = start(p, run->x);
    const double size = largest_of(run->x) / h;
    double best = INFINITY;
    int stalled = 0;
    *update = INFINITY;
    for (int made = 1; made <= MAX_FIXED_POINT_ITERATIONS; made++) {
        double new[N], previous = *update, total = 0.0;
        slopes(p, &s, run->x, run->low, h, k, new);
        *update = 0.0;
        EACH(i) {
            const double change = fabs(new[i] - k[i]);
            *update = larger(*update, change);
            total += change;
            k[i] = new[i];
        }
        *iterations = made;
        if (!isfinite(total))
            return NON_FINITE;
        stalled = *update < STALL_RATIO * best ? 0 : stalled + 1;
        best = smaller(best, *update);
        const double scale = size + largest_of(k);
        if (*update <= UPDATE_FLOOR * scale || (stalled >= 2 && *update <= PLATEAU_RTOL * scale))
            return RUNNING;
        if (made >= 3 && *update > FIXED_POINT_CONTRACTION_LIMIT * previous && best > PLATEAU_RTOL * scale)
            return NOT_CONVERGED;
    }
    return NOT_CONVERGED;
}

/* Where the energy is off by more than a few roundings of H, shift low along its gradient, by eps |x| / 4 at most. */
static inline void steer(const Problem *p, const double x[N], double energy, double first_energy, double low[N])
{
    double gradient[N], error = energy - first_energy, size = 0.0, square = 0.0;
    energy_gradient(p, x, gradient);
    EACH(i) {
        error += gradient[i] * low[i];
        size += fabs(gradient[i] * x[i]);
        square += gradient[i] * gradient[i];
    }
    if (!(fabs(error) > DRIFT_THRESHOLD * larger(fabs(first_energy), size)) || !(square > 0.0))
        return;
    const double most = 0.25 * DBL_EPSILON * size;
    const double shift = larger(-most, smaller(error, most)) / square;
    EACH(i)
        low[i] -= shift * gradient[i];
}

#ifndef OWN_MOVE
/* x + low is the state; Neumaier's two-sum catches the rounding of the sum. */
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
}
#endif

static inline int take_step(const Problem *p, double h, Run *run)
{
    double k[N], new[N], new_low[N], update, energy, entropy, total = 0.0;
    int iterations;
    EACH(i)
        k[i] = 2.0 * run->k[i] - run->before[i];
    const int status = solve(p, run, h, k, &update, &iterations);
    const double size = largest_of(run->x);
    run->residual = h * update / (size > 0.0 ? size : 1.0);
    if (status != RUNNING)
        return status;

    move(p, run->x, run->low, h, k, new, new_low);
    EACH(i)
        total += new[i];
    values(p, new, &energy, &entropy);
    if (!isfinite(total + energy + entropy))
        return NON_FINITE;
    steer(p, new, energy, run->first_energy, new_low);

    EACH(i) {
        run->before[i] = run->k[i];
        run->k[i] = k[i];
        run->x[i] = new[i];
        run->low[i] = new_low[i];
    }
    run->steps += 1;
    run->iterations += iterations;
    run->most_iterations = iterations > run->most_iterations ? iterations : run->most_iterations;
    run->worst_residual = larger(run->worst_residual, run->residual);
    run->largest_energy = larger(run->largest_energy, energy);
    run->smallest_energy = smaller(run->smallest_energy, energy);
    run->least_entropy_increment = smaller(run->least_entropy_increment, entropy - run->entropy);
    run->largest_energy_increment = larger(run->largest_energy_increment, energy - run->energy);
    run->integral += 0.5 * h * (run->entropy + entropy);
    run->energy = energy;
    run->entropy = entropy;
    return RUNNING;
}

/* From x0, `saves` times `every` steps of size h; out receives a state after each `every`, shape (saves, N). */
void integrate(const Problem *p, const double x0[N], double h, int64_t saves, int64_t every, double *out, Run *result)
{
    const double nothing[N] = {0.0};
    Run run = {.least_entropy_increment = INFINITY, .largest_energy_increment = -INFINITY};
    EACH(i)
        run.x[i] = x0[i];
    const Start s = start(p, x0);
    slopes(p, &s, x0, nothing, 0.0, nothing, run.k); /* a step of nothing has the vector field for its slope */
    EACH(i)
        run.before[i] = run.k[i];
    values(p, x0, &run.energy, &run.entropy);
    run.first_energy = run.largest_energy = run.smallest_energy = run.energy;

    for (int64_t save = 0; save < saves && run.status == RUNNING; save++) {
        for (int64_t step = 0; step < every && run.status == RUNNING; step++)
            run.status = take_step(p, h, &run);
        EACH(i)
            out[save * N + i] = run.x[i];
    }
    *result = run;
}
