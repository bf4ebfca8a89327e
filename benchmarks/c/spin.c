/* A spin s on S^2 with a bath of entropy S, with derivatives by hand,

       H = -a (s_3^2/2 + s_3^4/4) - b . s + exp(S),   s' = s x dH + K dS,   K(dS) = rate (|dH|^2 dS - (dH . dS) dH),

   by the midpoint scheme with the map exp~ [BFM 4.8]: z is the middle of the geodesic from x to x', and the discrete
   gradient (4.10) is taken in the chart v -> exp_z(v). The state is (s, S), a slope a tangent vector at x. As in
   general.c the difference of H is predicted from the gradient at three Gauss nodes; but along a geodesic only its
   derivative is needed at the outer ones. */

#include <string.h>

#include "axis_spin.h"
#include "gonzalez.h"
#include "rules.h"

#define OWN_MOVE

typedef struct {
    char none;
} Start;

/* The derivatives less what leads off the sphere. */
static inline void energy_gradient(const Problem *p, const double x[N], double out[N])
{
    derivatives(p, x, out);
    const double off = dot3(x, out);
    SPIN(i)
        out[i] -= off * x[i];
}

/* cos(angle) and sin(angle) / angle; the first terms of its series are exact below 1e-4. */
static inline void circle(double angle, double *cosine, double *sinc)
{
    *cosine = cos(angle);
    *sinc = angle > 1e-4 ? sin(angle) / angle : 1.0 - angle * angle / 6.0;
}

/* The point exp_z(t v), and where it is asked for its derivative by t; `angle` is |v|. */
static inline void geodesic(const double z[N], const double v[N], double angle, double t, double point[N],
                            double velocity[N])
{
    double cosine, sinc;
    circle(fabs(t) * angle, &cosine, &sinc);
    double square = 0.0;
    SPIN(i) {
        point[i] = cosine * z[i] + t * sinc * v[i];
        square += point[i] * point[i];
    }
    SPIN(i)
        point[i] *= 1.5 - 0.5 * square;
    point[3] = z[3] + t * v[3];
    if (!velocity)
        return;
    SPIN(i)
        velocity[i] = cosine * v[i] - t * angle * angle * sinc * z[i];
    velocity[3] = v[3];
}

/* The tangent vector u at z, taken along to exp_z(v). */
static inline void carry(const double z[N], const double v[N], double angle, const double u[N], double out[N])
{
    double cosine, sinc, half_cosine, half_sinc;
    circle(angle, &cosine, &sinc);
    circle(0.5 * angle, &half_cosine, &half_sinc);
    const double along = dot3(v, u);
    SPIN(i)
        out[i] = u[i] - along * (0.5 * half_sinc * half_sinc * v[i] + sinc * z[i]);
    out[3] = u[3];
}

static inline double directional(const Problem *p, const double z[N], const double d[N], double angle, double t)
{
    double point[N], velocity[N], slope[N];
    geodesic(z, d, angle, t, point, velocity);
    derivatives(p, point, slope);
    return dot(slope, velocity);
}

static inline Start start(const Problem *p, const double x[N])
{
    (void)p, (void)x;
    return (Start){0};
}

/* The middle z of the step h k from x, its way there and its angle; d is the step, at z. */
static inline double middle(const double x[N], double h, const double k[N], double half[N], double z[N], double d[N])
{
    const double off = dot3(x, k);
    EACH(i)
        half[i] = 0.5 * h * (i < 3 ? k[i] - off * x[i] : k[i]);
    const double angle = sqrt(dot3(half, half));
    geodesic(x, half, angle, 1.0, z, NULL);
    carry(x, half, angle, half, d);
    EACH(i)
        d[i] *= 2.0;
    return angle;
}

static inline void slopes(const Problem *p, const Start *s, const double x[N], const double low[N], double h,
                          const double k[N], double out[N])
{
    double half[N], z[N], d[N], slope[N], ends[2][N];
    (void)s, (void)low;
    const double angle = middle(x, h, k, half, z, d), whole = 2.0 * angle;

    energy_gradient(p, z, slope);
    const double along = dot(slope, d);
    const double second =
        directional(p, z, d, whole, NODE - 0.5) + directional(p, z, d, whole, 0.5 - NODE) - 2.0 * along;
    geodesic(z, d, whole, -0.5, ends[0], NULL);
    geodesic(z, d, whole, 0.5, ends[1], NULL);
    const double before = energy_of(p, ends[0]), after = energy_of(p, ends[1]);
    const double square = dot(d, d), size = sqrt(dot(slope, slope)), length = sqrt(square);
    double defect = (after - before) - (along + (5.0 / 18.0) * second);
    const double noise = DIFFERENCE_NOISE * (fabs(before) + fabs(after)) + 2.0 * EPS * size * length;
    const double by_size = gate(defect, noise), by_curve = gate(second, CURVATURE_SWITCH * size * length);
    defect *= by_size > by_curve ? by_size : by_curve;
    const double factor = square > TINY ? ((5.0 / 18.0) * second + defect) / square : 0.0;

    double w[N], there[N], back[N];
    EACH(i)
        w[i] = slope[i] + factor * d[i];
    const double heat = dot(w, w);
    there[0] = z[1] * w[2] - z[2] * w[1] - p->rate * w[3] * w[0];
    there[1] = z[2] * w[0] - z[0] * w[2] - p->rate * w[3] * w[1];
    there[2] = z[0] * w[1] - z[1] * w[0] - p->rate * w[3] * w[2];
    there[3] = p->rate * (heat - w[3] * w[3]);
    EACH(i)
        back[i] = -0.5 * d[i];
    carry(z, back, angle, there, out);
}

static inline void move(const Problem *p, const double x[N], const double low[N], double h, const double k[N],
                        double new[N], double new_low[N])
{
    double half[N], z[N], d[N], v[N];
    (void)p;
    const double angle = middle(x, h, k, half, z, d);
    carry(x, half, angle, low, v); /* what steers the energy */
    EACH(i)
        v[i] += 0.5 * d[i];
    geodesic(z, v, sqrt(dot3(v, v)), 1.0, new, NULL);
    if (!(angle < M_PI_2)) /* the domain of exp~ */
        new[0] = NAN;
    memset(new_low, 0, N * sizeof(double));
}

static inline void values(const Problem *p, const double x[N], double *energy, double *entropy)
{
    *energy = energy_of(p, x);
    *entropy = x[3];
}

#include "midpoint.h"
