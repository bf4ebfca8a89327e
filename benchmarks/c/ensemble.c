/* Many relaxed rigid bodies: the step loop of rigid_body.c on WIDTH bodies at a time, one in each lane of a vector,
   and blocks of bodies handed out to threads.

   The lanes iterate together until the last has settled; a lane that settles or fails keeps what it has, so every
   body takes the iterates that it would take alone. */

#include <pthread.h>
#include <stdatomic.h>

#include "lanes.h"
#include "rules.h"

#define N 3
#define MAX_THREADS 256

typedef struct {
    double inverse_inertia[N];
    double rate;
} Problem;

typedef struct {
    double x[N];
    double first_energy, largest_energy, smallest_energy;
    double entropy, least_entropy_increment;
    double steps, iterations, integral;
    int64_t status;
} Summary;

typedef struct {
    Lanes x[N], low[N], k[N], before[N];
    Lanes first_energy, largest_energy, smallest_energy;
    Lanes entropy, least_entropy_increment;
    Lanes steps, iterations, integral;
    Mask running, undefined; /* a lane that is not running has failed: undefined, or not converged */
} Block;

static inline Lanes largest_of(const Lanes v[N])
{
    return larger(larger(absolute(v[0]), absolute(v[1])), absolute(v[2]));
}

static inline void slopes(const Problem *p, const Lanes x[N], const Lanes low[N], double h, const Lanes k[N],
                          Lanes out[N])
{
    Lanes z[N], w[N];
    EACH(i) {
        z[i] = x[i] + (low[i] + 0.5 * h * k[i]);
        w[i] = p->inverse_inertia[i] * z[i];
    }
    const Lanes u0 = z[0] + p->rate * (w[1] * z[2] - w[2] * z[1]);
    const Lanes u1 = z[1] + p->rate * (w[2] * z[0] - w[0] * z[2]);
    const Lanes u2 = z[2] + p->rate * (w[0] * z[1] - w[1] * z[0]);
    out[0] = u1 * w[2] - u2 * w[1];
    out[1] = u2 * w[0] - u0 * w[2];
    out[2] = u0 * w[1] - u1 * w[0];
}

static inline void values(const Problem *p, const Lanes x[N], Lanes *energy, Lanes *entropy)
{
    const double *a = p->inverse_inertia;
    *energy = 0.5 * (a[0] * x[0] * x[0] + a[1] * x[1] * x[1] + a[2] * x[2] * x[2]);
    *entropy = 0.5 * (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
}

/* Solve the step equations of the running lanes from the guess in k, in place; lanes where that fails stop running. */
static inline void solve(const Problem *p, Block *b, double h, Lanes k[N])
{
    const Lanes size = largest_of(b->x) / h;
    Lanes update = all(INFINITY), best = update;
    Mask active = b->running, stalled = none();
    for (int made = 1; made <= MAX_FIXED_POINT_ITERATIONS && any(active); made++) {
        Lanes new[N], change[N];
        slopes(p, b->x, b->low, h, k, new);
        EACH(i) {
            change[i] = absolute(new[i] - k[i]);
            k[i] = choose(active, new[i], k[i]);
        }
        const Lanes previous = update;
        update = larger(larger(change[0], change[1]), change[2]);
        b->iterations += one_in(active);

        const Mask defined = finite_lanes(change[0] + change[1] + change[2]);
        const Mask stuck = ~below(update, STALL_RATIO * best), twice = stuck & stalled;
        stalled = stuck;
        best = smaller(best, update);
        const Lanes scale = size + largest_of(k);
        const Mask settled = at_most(update, UPDATE_FLOOR * scale) | (twice & at_most(update, PLATEAU_RTOL * scale));
        Mask hopeless = ~defined;
        if (made >= 3)
            hopeless |= ~settled & below(FIXED_POINT_CONTRACTION_LIMIT * previous, update)
                & below(PLATEAU_RTOL * scale, best);
        b->undefined |= active & ~defined;
        b->running &= ~(active & hopeless);
        active &= ~(settled | hopeless);
    }
    b->running &= ~active;
}

/* Where the energy is off by more than a few roundings of H, shift low along its gradient, by eps |x| / 4 at most. */
static inline void steer(const Problem *p, const Lanes x[N], Lanes energy, Lanes first_energy, Lanes low[N])
{
    Lanes gradient[N], error = energy - first_energy, size = all(0.0), square = all(0.0);
    EACH(i) {
        gradient[i] = p->inverse_inertia[i] * x[i];
        error += gradient[i] * low[i];
        size += absolute(gradient[i] * x[i]);
        square += gradient[i] * gradient[i];
    }
    const Mask off = below(DRIFT_THRESHOLD * larger(absolute(first_energy), size), absolute(error))
        & below(all(0.0), square);
    if (!any(off))
        return;
    const Lanes most = 0.25 * DBL_EPSILON * size;
    const Lanes shift = choose(off, larger(-most, smaller(error, most)) / square, all(0.0));
    EACH(i)
        low[i] -= shift * gradient[i];
}

static inline void take_step(const Problem *p, double h, Block *b)
{
    Lanes k[N], new[N], new_low[N], energy, entropy;
    EACH(i)
        k[i] = 2.0 * b->k[i] - b->before[i];
    solve(p, b, h, k);

    EACH(i) { /* x + low is the state; Neumaier's two-sum catches the rounding of the sum */
        const Lanes increment = h * k[i] + b->low[i];
        new[i] = b->x[i] + increment;
        const Lanes back = new[i] - b->x[i];
        new_low[i] = (b->x[i] - (new[i] - back)) + (increment - back);
    }
    values(p, new, &energy, &entropy);
    const Mask defined = finite_lanes(new[0] + new[1] + new[2] + energy + entropy);
    b->undefined |= b->running & ~defined;
    b->running &= defined;

    steer(p, new, energy, b->first_energy, new_low);

    const Mask good = b->running;
    EACH(i) {
        b->before[i] = choose(good, b->k[i], b->before[i]);
        b->k[i] = choose(good, k[i], b->k[i]);
        b->x[i] = choose(good, new[i], b->x[i]);
        b->low[i] = choose(good, new_low[i], b->low[i]);
    }
    b->steps += one_in(good);
    b->largest_energy = choose(good, larger(b->largest_energy, energy), b->largest_energy);
    b->smallest_energy = choose(good, smaller(b->smallest_energy, energy), b->smallest_energy);
    b->least_entropy_increment =
        choose(good, smaller(b->least_entropy_increment, entropy - b->entropy), b->least_entropy_increment);
    b->integral += choose(good, 0.5 * h * (b->entropy + entropy), all(0.0));
    b->entropy = choose(good, entropy, b->entropy);
}

typedef struct {
    const Problem *problem;
    const double *x0;
    double h;
    int64_t bodies, steps;
    Summary *out;
    atomic_long next;
} Work;

static void run_block(const Work *work, int64_t first)
{
    const Problem *p = work->problem;
    const Lanes nothing[N] = {all(0.0), all(0.0), all(0.0)};
    Lanes energy;
    Block b = {.running = every(), .undefined = none(), .least_entropy_increment = all(INFINITY)};
    b.steps = b.iterations = b.integral = all(0.0);
    EACH(i) {
        for (int lane = 0; lane < WIDTH; lane++) { /* lanes beyond the last body repeat it */
            const int64_t body = first + lane < work->bodies ? first + lane : work->bodies - 1;
            b.x[i][lane] = work->x0[N * body + i];
        }
        b.low[i] = all(0.0);
    }
    slopes(p, b.x, b.low, 0.0, nothing, b.k); /* a step of nothing has the vector field for its slope */
    EACH(i)
        b.before[i] = b.k[i];
    values(p, b.x, &energy, &b.entropy);
    b.first_energy = b.largest_energy = b.smallest_energy = energy;

    for (int64_t step = 0; step < work->steps && any(b.running); step++)
        take_step(p, work->h, &b);

    for (int lane = 0; lane < WIDTH && first + lane < work->bodies; lane++)
        work->out[first + lane] = (Summary){
            .x = {b.x[0][lane], b.x[1][lane], b.x[2][lane]},
            .first_energy = b.first_energy[lane],
            .largest_energy = b.largest_energy[lane],
            .smallest_energy = b.smallest_energy[lane],
            .entropy = b.entropy[lane],
            .least_entropy_increment = b.least_entropy_increment[lane],
            .steps = b.steps[lane],
            .iterations = b.iterations[lane],
            .integral = b.integral[lane],
            .status = chosen(b.running, lane) ? RUNNING : chosen(b.undefined, lane) ? NON_FINITE : NOT_CONVERGED,
        };
}

static void *run_blocks(void *argument)
{
    Work *work = argument;
    for (int64_t first; (first = atomic_fetch_add(&work->next, WIDTH)) < work->bodies;)
        run_block(work, first);
    return NULL;
}

/* From each of the x0, shape (bodies, N), `steps` steps of size h, on so many threads. */
void integrate_ensemble(const Problem *p, const double *x0, int64_t bodies, double h, int64_t steps, int64_t threads,
                        Summary *out)
{
    Work work = {.problem = p, .x0 = x0, .h = h, .bodies = bodies, .steps = steps, .out = out};
    pthread_t others[MAX_THREADS];
    int started = 0;
    while (started < threads - 1 && started < MAX_THREADS && !pthread_create(&others[started], NULL, run_blocks, &work))
        started++;
    run_blocks(&work);
    for (int i = 0; i < started; i++)
        pthread_join(others[i], NULL);
}
