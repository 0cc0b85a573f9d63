/* The functions of smoother.py, range_weights.py, noise_level.py and gauss_newton.py, which explain them, with
   the same operations in the same order.

   Matrices are stored row by row. Compile without contraction of products and sums (-ffp-contract=off) and
   without fast math: results then follow from this text and from the functions of the C library alone. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifndef SOURCE
#define SOURCE ""
#endif

/* The SHA-256 of this text, which the build gives. */
const char *source(void) { return SOURCE; }

const char *compiler(void)
{
#if defined(__clang__)
    return "clang " __clang_version__;
#elif defined(__GNUC__)
    return "gcc " __VERSION__;
#else
    return "an unknown compiler";
#endif
}

#define SLIGHT 1e-4
#define SMALLEST_DISTANCE 1e-12
#define LARGEST_TURN 1.0
#define FAR 32.0
#define BLIND 1e-9
#define MEDIAN 0.6745
#define SOFT 0.1
#define LARGEST_RATIO 700.0
#define INLIER 0.5
#define BY_CHANCE 2.0
#define LEAST_LEVEL 0.25
#define ROUNDED 1e-12
#define MOST_CORRELATED 0.8
#define LAST_STEP 3e-3
#define LARGEST_STEP 0.3
#define DESCENT 1e-6
#define SETTLED_WEIGHT 1e-2
#define WEIGHT_DAMPING 0.5
#define RIDGE 1e-12
#define GRAIN 1e-12
#define LEAST_VARIANCE 1e-300
static const double SHORTER_STEPS[] = {1.0, 0.5, 0.25, 0.0625};

typedef long long Index;

/* What a function returns that got no memory. */
enum { NO_MEMORY = -2 };

/* A function that is compiled for each of the sizes of BY_SIZE. */
#define SIZED static inline __attribute__((always_inline))

/* A function that is compiled for wider vectors, too; the same operations have the same results. */
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define CLONED __attribute__((target_clones("avx2", "default")))
#else
#define CLONED
#endif

/* smoother.Measured: first the numbers, then the arrays, which `prepared` finds. */
typedef struct {
    Index robots, ticks, ranges, common, constant, anchors, radios, scaled, delayed, deep, strays;
    double period, survey, slow, decay, scale;
    const double *v, *omega, *slip, *white, *stray, *patterns, *place, *rho, *effects, *mean, *information;
    const double *pivot;
    const Index *begin, *first, *second, *observer, *anchor, *radio;
} Measured;

/* smoother.Walk */
typedef struct {
    double *place, *moves, *direction, *residual, *rate, *by_heading, *to_depth, *aside;
} Walk;

/* smoother.Passed and smoother.Adjoint; `row_of` has the places and derivatives of a range. Those from
   `updated` on are vectors of a fit: with an element for each range, the limited step with one for each unknown,
   and then the weights and the noise of the ticks. */
typedef struct {
    double *innovation, *variance, *effects, *gain, *state, *u, *p, *information, *gradient;
    double *misfit, *of_limited, *adjoint, *adjoint_limited, *by_unknowns, *weight, *weighted, *effect;
    double *lower, *whitening, *inner, *vector, *other;
    double *updated, *changed, *damping, *errors, *spread, *ratios, *shorter, *sound, *noise;
} Work;

/* smoother.Step */
typedef struct {
    double *change, *limited, *inverse, *white, *own, *slow, *multipliers, *alone, *explained, *ends, *shocks;
    double *numbers;
} Step;

/* range_weights.Weighing: first the numbers, then the arrays. */
typedef struct {
    double longest, inlier, outlier, stray, least, most, degrees, astray, astray_ratio;
    Index free, robust, noisy;
    const double *sigma;
    const Index *holding, *by_radio;
} Weighing;

/* gauss_newton.Convergence */
typedef struct {
    Index steps;
    double shortest, decrease;
} Convergence;

/* gauss_newton.Point */
typedef struct {
    double *poses, *common, *constant, *white, *slow, *of_slow;
    Walk walk;
    double *own, *prior_cost;
} Point;

/* gauss_newton.Fitted: `model` and `final` are places in `points`; `numbers` are the last step, the noise
   level, the number of inliers, the part of the outliers, and the places. */
typedef struct {
    Point points[2];
    Step step;
    double *weights, *variance, *sound, *numbers;
} Fitted;

typedef struct {
    Index at[6];
    double by[6];
    int count;
} Row;

/* Those of Python: the first one unless the other one is larger, or less. */
static double larger(double one, double other) { return other > one ? other : one; }

static double smaller(double one, double other) { return other < one ? other : one; }

/* --- linear algebra --------------------------------------------------------------------------------- */

/* Teams with an exact odometry, and ranges that concern two robots of many, have mostly factors of 0. */
SIZED void add(double *restrict to, double factor, const double *restrict what, Index count)
{
    if (factor == 0.0) return;
    for (Index e = 0; e < count; e++) to[e] += factor * what[e];
}

SIZED void scale(double *vector, double factor, Index count)
{
    for (Index e = 0; e < count; e++) vector[e] *= factor;
}

SIZED double dot(const double *one, const double *other, Index count)
{
    double total = 0.0;
    for (Index e = 0; e < count; e++) total += one[e] * other[e];
    return total;
}

/* `matrix` has rows of `width` elements, and `lower` of `end - begin`. Returns 0 if it is not positive. Column by
   column, the elements right of it sum up the products that are subtracted from those of `matrix`. */
SIZED int cholesky(const double *matrix, Index width, Index begin, Index end, double *column, double *lower)
{
    const Index size = end - begin;
    memset(lower, 0, sizeof(double) * size * size);
    for (Index e = 0; e < size; e++) {
        const double left = matrix[(begin + e) * width + begin + e] - lower[e * size + e];
        if (!(left > 0.0)) return 0;
        const double root = lower[e * size + e] = sqrt(left);
        for (Index a = e + 1; a < size; a++) {
            double *row = lower + a * size;
            row[e] = column[a] = (matrix[(begin + a) * width + begin + e] - row[e]) / root;
            add(row + e + 1, row[e], column + e + 1, a - e);
        }
    }
    return 1;
}

SIZED void substituted(const double *lower, Index size, const double *right, double *found)
{
    for (Index a = 0; a < size; a++)
        found[a] = (right[a] - dot(lower + a * size, found, a)) / lower[a * size + a];
}

SIZED void solved(const double *lower, Index size, const double *right, double *found)
{
    substituted(lower, size, right, found);
    for (Index a = size - 1; a >= 0; a--) {
        found[a] /= lower[a * size + a];
        add(found, -found[a], lower + a * size, a);
    }
}

/* The transposed inverse of `lower`, and that inverse, from which `completed` goes on, for all columns at once. */
SIZED void inverted(const double *lower, Index size, double *row, double *whitening, double *inverse)
{
    memset(inverse, 0, sizeof(double) * size * size);
    memset(whitening, 0, sizeof(double) * size * size);
    for (Index a = 0; a < size; a++) {
        memset(row, 0, sizeof(double) * size);
        for (Index e = 0; e < a; e++) add(row, lower[a * size + e], inverse + e * size, e + 1);
        for (Index c = 0; c <= a; c++) inverse[a * size + c] = ((c == a) - row[c]) / lower[a * size + a];
        for (Index c = 0; c <= a; c++) whitening[c * size + a] = inverse[a * size + c];
    }
}

/* The columns from `begin` to `end` of the inverse of a matrix by that of its `lower`; those before have it. The
   elements below the diagonal are those above it. */
SIZED void completed(const double *lower, Index size, Index begin, Index end, double *row, double *inverse)
{
    for (Index a = size - 1; a >= 0; a--) {
        double *left = inverse + a * size;
        for (Index c = begin; c < end; c++) row[c] = -(left[c] /= lower[a * size + a]);
        for (Index e = 0; e < a; e++)
            add(inverse + e * size + begin, lower[a * size + e], row + begin, end - begin);
    }
    for (Index a = 0; a < end; a++)
        for (Index e = 0; e < a; e++) inverse[a * size + e] = inverse[e * size + a];
}

SIZED void whitened(const double *whitening, Index size, const double *vector, double *found)
{
    memset(found, 0, sizeof(double) * size);
    for (Index e = 0; e < size; e++) add(found + e, vector[e], whitening + e * size + e, size - e);
}

/* --- sizes ------------------------------------------------------------------------------------------ */

SIZED Index states(const Measured *of) { return 3 * of->robots + of->radios; }

SIZED Index estimated(const Measured *of) { return 3 * of->robots + of->common + of->robots * of->constant; }

SIZED Index unknowns(const Measured *of) { return estimated(of) + 2 * of->anchors; }

/* --- the paths -------------------------------------------------------------------------------------- */

/* The velocity of robot `i` at the end of the tick before `k`. */
static void velocity_of(const Measured *of, const Walk *walk, Index i, Index k, double by[2])
{
    const Index K = of->ticks, before = i * K + k - 1;
    const double v = of->v[before] + walk->moves[8 * before + 6];
    const double course = walk->place[3 * (i * (K + 1) + k) + 2] + of->slip[before];
    by[0] = v * cos(course);
    by[1] = v * sin(course);
}

/* Sets all but the paths for range `j`, at tick `k`; `deep` has the errors that make it a depth. */
static void predict(const Measured *of, const double *deep, Index j, Index k, Walk *to)
{
    const Index ticks = of->ticks + 1, first = of->first[j], second = of->second[j];
    const Index observer = of->observer[j];
    const double *at = to->place + 3 * (first * ticks + k), *other = of->place + 2 * j;
    if (second >= 0) other = to->place + 3 * (second * ticks + k);
    const double dx = at[0] - other[0], dy = at[1] - other[1];
    double distance = sqrt(dx * dx + dy * dy);
    if (distance < SMALLEST_DISTANCE) distance = SMALLEST_DISTANCE;
    double x = dx / distance, y = dy / distance;
    to->residual[j] = of->rho[j] - distance;
    to->rate[j] = to->by_heading[j] = to->to_depth[j] = to->aside[j] = 0.0;
    if (of->deep >= 0) {
        const double *effects = of->effects + j * of->common + of->deep;
        const double share = deep[0] * effects[0], side = deep[1] * effects[1], rest = 1.0 - share;
        const double heading = to->place[3 * (observer * ticks + k) + 2];
        const double sign = observer == second ? 1.0 : -1.0;
        const double c = sign * cos(heading), s = sign * sin(heading);
        const double ahead = dx * c + dy * s, left = dy * c - dx * s;
        to->to_depth[j] = ahead - distance;
        to->aside[j] = left;
        to->by_heading[j] = share * left - side * ahead;
        x = rest * x + share * c - side * s;
        y = rest * y + share * s + side * c;
    }
    to->direction[2 * j] = x;
    to->direction[2 * j + 1] = y;
    if (of->delayed >= 0 && k > 0) {
        double by[2], of_other[2];
        velocity_of(of, to, first, k, by);
        if (second >= 0) {
            velocity_of(of, to, second, k, of_other);
            by[0] -= of_other[0];
            by[1] -= of_other[1];
        }
        const Index before = observer * of->ticks + k - 1;
        const double omega = of->omega[before] + to->moves[8 * before + 7];
        to->rate[j] = x * by[0] + y * by[1] + to->by_heading[j] * omega;
    }
}

static void walked(
    const Measured *of, const double *poses, const double *constants, const double *white,
    const double *deep, Walk *to)
{
    const Index K = of->ticks, m = of->constant;
    for (Index i = 0; i < of->robots; i++) {
        double x = poses[3 * i], y = poses[3 * i + 1], heading = poses[3 * i + 2];
        double *place = to->place + 3 * i * (K + 1), *move = to->moves + 8 * i * K;
        place[0] = x; place[1] = y; place[2] = heading;
        for (Index k = 0; k < K; k++, move += 8) {
            double error_v = white[2 * i * K + k], error_omega = white[(2 * i + 1) * K + k];
            for (Index j = 0; j < m; j++) {
                const double *pattern = of->patterns + 2 * (i * m + j) * K;
                error_v += constants[i * m + j] * pattern[k];
                error_omega += constants[i * m + j] * pattern[K + k];
            }
            const double v = of->v[i * K + k] + error_v, omega = of->omega[i * K + k] + error_omega;
            const double half = 0.5 * of->period * omega;
            double unit, slope;
            if (fabs(half) < SLIGHT) {
                unit = of->period * (1.0 - half * half / 6.0);
                slope = -0.5 * of->period * half / 3.0;
            } else {
                unit = of->period * sin(half) / half;
                slope = 0.5 * of->period * (1.0 / tan(half) - 1.0 / half);
            }
            const double course = heading + half + of->slip[i * K + k];
            const double sx = unit * cos(course), sy = unit * sin(course), dx = v * sx, dy = v * sy;
            move[0] = sx; move[1] = sy; move[2] = dx; move[3] = dy;
            move[4] = v * slope * sx - 0.5 * of->period * dy;
            move[5] = v * slope * sy + 0.5 * of->period * dx;
            move[6] = error_v; move[7] = error_omega;
            x = x + dx; y = y + dy; heading = heading + of->period * omega;
            place += 3;
            place[0] = x; place[1] = y; place[2] = heading;
        }
    }
    for (Index k = 0; k <= K; k++)
        for (Index j = of->begin[k]; j < of->begin[k + 1]; j++) predict(of, deep, j, k, to);
}

/* The derivatives of the start pose of robot `i` with respect to its unknowns. */
SIZED void basis_of(const Measured *of, const double *poses, Index i, double by[3][3])
{
    double x = poses[3 * i] - of->pivot[2 * i], y = poses[3 * i + 1] - of->pivot[2 * i + 1];
    if (isnan(x)) x = y = 0.0;
    const double c = cos(poses[3 * i + 2]), s = sin(poses[3 * i + 2]);
    const double rows[3][3] = {{-c, s, -y}, {-s, -c, x}, {0.0, 0.0, 1.0}};
    memcpy(by, rows, sizeof rows);
}

/* --- the forward pass ------------------------------------------------------------------------------- */

SIZED void moved(const Measured *of, const Walk *walk, Index i, Index k, Work *w)
{
    const Index s = states(of), q = unknowns(of), K = of->ticks, m = of->constant;
    const double *move = walk->moves + 8 * (i * K + k), T = of->period;
    const double sx = move[0], sy = move[1], dx = move[2], dy = move[3], gx = move[4], gy = move[5];
    const Index x = 3 * i, y = 3 * i + 1, h = 3 * i + 2;
    double *state = w->state, *u = w->u, *p = w->p;
    state[x] += -dy * state[h] - sx * move[6] - gx * move[7];
    state[y] += dx * state[h] - sy * move[6] - gy * move[7];
    state[h] -= T * move[7];
    add(u + x * q, -dy, u + h * q, q);
    add(u + y * q, dx, u + h * q, q);
    Index column = 3 * of->robots + of->common + i * m;
    for (Index j = 0; j < m; j++, column++) {
        const double *pattern = of->patterns + 2 * (i * m + j) * K;
        u[x * q + column] += sx * pattern[k] + gx * pattern[K + k];
        u[y * q + column] += sy * pattern[k] + gy * pattern[K + k];
        u[h * q + column] += T * pattern[K + k];
    }
    add(p + x * s, -dy, p + h * s, s);
    add(p + y * s, dx, p + h * s, s);
    for (Index a = 0; a < s; a++) {
        double *row = p + a * s;
        row[x] += -dy * row[h];
        row[y] += dx * row[h];
    }
    const double v = of->white[2 * i * K + k], omega = of->white[(2 * i + 1) * K + k];
    const double by_v[3] = {sx, sy, 0.0}, by_omega[3] = {gx, gy, T};
    for (Index a = 0; a < 3; a++)
        for (Index e = 0; e < 3; e++)
            p[(x + a) * s + x + e] += v * by_v[a] * by_v[e] + omega * by_omega[a] * by_omega[e];
}

SIZED void decayed(const Measured *of, Work *w)
{
    const Index s = states(of), q = unknowns(of);
    for (Index a = 3 * of->robots; a < s; a++) {
        w->state[a] *= of->decay;
        scale(w->u + a * q, of->decay, q);
        scale(w->p + a * s, of->decay, s);
        for (Index e = 0; e < s; e++) w->p[e * s + a] *= of->decay;
        w->p[a * s + a] += (1.0 - of->decay * of->decay) * of->slow;
    }
}

SIZED Row row_of(const Measured *of, const Walk *walk, Index j)
{
    const double x = walk->direction[2 * j], y = walk->direction[2 * j + 1];
    Row row = {{3 * of->first[j], 3 * of->first[j] + 1}, {x, y}, 2};
    if (of->deep >= 0) {
        row.at[2] = 3 * of->observer[j] + 2;
        row.by[2] = walk->by_heading[j];
        row.count = 3;
    }
    if (of->second[j] >= 0) {
        for (Index e = 0; e < 2; e++, row.count++) {
            row.at[row.count] = 3 * of->second[j] + e;
            row.by[row.count] = e ? -y : -x;
        }
    }
    if (of->radios && of->radio[j] >= 0) {
        row.at[row.count] = 3 * of->robots + of->radio[j];
        row.by[row.count] = 1.0;
        row.count++;
    }
    return row;
}

/* The effect of one sigma of the constant error `e` on range `j`. */
SIZED double effect_of(const Measured *of, const Walk *walk, Index j, Index e)
{
    const double told = of->effects[j * of->common + e];
    if (e == of->delayed) return -told * walk->rate[j];
    if (of->deep >= 0 && e >= of->deep) return told * (e == of->deep ? walk->to_depth : walk->aside)[j];
    return e == of->scaled && told != 0.0 ? of->scale * (of->rho[j] - walk->residual[j]) : told;
}

/* Returns 0 if rounding has left no variance. */
SIZED int measured(const Measured *of, const Walk *walk, Index j, double variance, Work *w)
{
    const Index s = states(of), q = unknowns(of), size = estimated(of);
    const Row row = row_of(of, walk, j);
    double *effect = w->effects + j * q, *gain = w->gain + j * s, innovation = walk->residual[j];
    memset(effect, 0, sizeof(double) * q);
    memset(gain, 0, sizeof(double) * s);
    for (int t = 0; t < row.count; t++) {
        innovation -= row.by[t] * w->state[row.at[t]];
        add(effect, row.by[t], w->u + row.at[t] * q, q);
        add(gain, row.by[t], w->p + row.at[t] * s, s);
    }
    for (Index e = 0; e < of->common; e++) effect[3 * of->robots + e] += effect_of(of, walk, j, e);
    if (of->anchor[j] >= 0)
        for (Index e = 0; e < 2; e++)
            effect[size + 2 * of->anchor[j] + e] -= of->survey * walk->direction[2 * j + e];
    for (int t = 0; t < row.count; t++) variance += row.by[t] * gain[row.at[t]];
    w->innovation[j] = innovation;
    w->variance[j] = variance;
    return variance > 0.0;
}

SIZED void updated(const Measured *of, Index j, Work *w)
{
    const Index s = states(of), q = unknowns(of);
    const double innovation = w->innovation[j], weight = 1.0 / w->variance[j];
    double *effect = w->effects + j * q, *gain = w->gain + j * s;
    for (Index a = 0; a < s; a++) {
        w->state[a] += gain[a] * weight * innovation;
        add(w->u + a * q, -(gain[a] * weight), effect, q);
        add(w->p + a * s, -(gain[a] * weight), gain, s);
    }
    scale(gain, weight, s);
    for (Index a = 0; a < q; a++) {
        w->gradient[a] += effect[a] * weight * innovation;
        add(w->information + a * q, effect[a] * weight, effect, a + 1);
    }
}

/* Set the effects of the unknowns of the start poses on them, and what their priors tell. */
SIZED void begun(const Measured *of, const double *poses, Work *w)
{
    const Index n3 = 3 * of->robots, q = unknowns(of);
    double by[3][3], *told = w->vector, *row = w->other;
    for (Index i = 0; i < n3; i += 3) {
        basis_of(of, poses, i / 3, by);
        for (Index a = 0; a < 3; a++) memcpy(w->u + (i + a) * q + i, by[a], sizeof by[a]);
    }
    for (Index a = 0; a < n3; a++) {
        told[a] = 0.0;
        for (Index e = 0; e < n3; e++) told[a] += of->information[a * n3 + e] * (of->mean[e] - poses[e]);
    }
    for (Index a = 0; a < n3; a++) {
        const Index i = a - a % 3;
        memset(row, 0, sizeof(double) * n3);
        for (Index d = i; d < i + 3; d++) {
            w->gradient[a] += w->u[d * q + a] * told[d];
            add(row, w->u[d * q + a], of->information + d * n3, n3);
        }
        for (Index e = 0; e < n3; e++)
            for (Index d = e - e % 3; d < e - e % 3 + 3; d++)
                w->information[a * q + e] += row[d] * w->u[d * q + e];
    }
}

SIZED int forward(
    const Measured *of, const Walk *walk, const double *poses, const double *variance, int update, Work *w)
{
    const Index n3 = 3 * of->robots, s = states(of), q = unknowns(of);
    memset(w->state, 0, sizeof(double) * s);
    memset(w->u, 0, sizeof(double) * s * q);
    memset(w->p, 0, sizeof(double) * s * s);
    memset(w->information, 0, sizeof(double) * q * q);
    memset(w->gradient, 0, sizeof(double) * q);
    begun(of, poses, w);
    for (Index a = n3; a < s; a++) w->p[a * s + a] = of->slow;
    for (Index a = n3; a < q; a++) w->information[a * q + a] = 1.0;
    for (Index k = 0; k <= of->ticks; k++) {
        if (k > 0) {
            for (Index i = 0; i < of->robots; i++) moved(of, walk, i, k - 1, w);
            decayed(of, w);
        }
        for (Index j = of->begin[k]; j < of->begin[k + 1]; j++) {
            if (!measured(of, walk, j, variance[j], w)) return 0;
            if (update) updated(of, j, w);
        }
    }
    return 1;
}

SIZED int sized_loosened(
    const Measured *of, const Walk *walk, const double *poses, const double *variance, Work *w, double *found)
{
    const Index q = unknowns(of), size = estimated(of);
    if (!forward(of, walk, poses, variance, 0, w)) return 0;
    for (Index j = 0; j < of->ranges; j++) {
        found[j] = w->variance[j];
        const double *effect = w->effects + j * q;
        for (Index e = 3 * of->robots; e < size; e++) found[j] += effect[e] * effect[e];
    }
    return 1;
}

/* --- the step --------------------------------------------------------------------------------------- */

SIZED int limited(const Measured *of, double largest, const double *change, Work *w, double *found)
{
    const Index n3 = 3 * of->robots, q = unknowns(of), size = estimated(of);
    double most = 0.0;
    for (Index a = 0; a < n3; a++) {
        const double share = fabs(change[a]) / (a % 3 == 2 ? LARGEST_TURN : largest);
        if (share > most) most = share;
    }
    memcpy(found, change, sizeof(double) * size);
    if (most <= 1.0) return 1;
    for (Index a = 0; a < n3; a++) found[a] = change[a] / most;
    for (Index a = n3; a < size; a++)
        w->vector[a - n3] = w->gradient[a] - dot(w->information + a * q, found, n3);
    if (!cholesky(w->information, q, n3, size, w->effect, w->inner)) return 0;
    solved(w->inner, size - n3, w->vector, found + n3);
    return 1;
}

/* What remains of the innovations after a change. */
SIZED void misfits(const Measured *of, const double *change, const Work *w, double *found)
{
    const Index q = unknowns(of), size = estimated(of);
    Index j = 0;
    for (; j + 4 <= of->ranges; j += 4) { /* four sums at once do not wait for each other */
        const double *effect = w->effects + j * q;
        double totals[4] = {0.0, 0.0, 0.0, 0.0};
        for (Index e = 0; e < size; e++)
            for (Index t = 0; t < 4; t++) totals[t] += effect[t * q + e] * change[e];
        for (Index t = 0; t < 4; t++) found[j + t] = w->innovation[j + t] - totals[t];
    }
    for (; j < of->ranges; j++) found[j] = w->innovation[j] - dot(w->effects + j * q, change, size);
}

SIZED double chi2_of(const Measured *of, const double *poses, const double *change, Work *w)
{
    const Index n3 = 3 * of->robots, size = estimated(of);
    double chi2 = 0.0, by[3][3], *off = w->vector;
    for (Index j = 0; j < of->ranges; j++) chi2 += w->misfit[j] * w->misfit[j] / w->variance[j];
    chi2 += dot(change + n3, change + n3, size - n3);
    for (Index i = 0; i < n3; i += 3) {
        basis_of(of, poses, i / 3, by);
        for (Index a = 0; a < 3; a++) off[i + a] = of->mean[i + a] - poses[i + a] - dot(by[a], change + i, 3);
    }
    for (Index a = 0; a < n3; a++) chi2 += off[a] * dot(of->information + a * n3, off, n3);
    return chi2;
}

SIZED void weighed_in(const Measured *of, const Walk *walk, Index j, Work *w, Step *to)
{
    const Index s = states(of), q = unknowns(of), size = estimated(of);
    const double *gain = w->gain + j * s, spread = w->variance[j];
    to->multipliers[j] = w->misfit[j] / spread - dot(gain, w->adjoint, s);
    to->own[j] = w->of_limited[j] / spread - dot(gain, w->adjoint_limited, s);
    double *effect = w->effect, *weighted = w->weighted;
    for (Index e = 0; e < size; e++) effect[e] = w->effects[j * q + e] / spread;
    for (Index a = 0; a < s; a++) add(effect, -gain[a], w->by_unknowns + a * size, size);
    int moves = 0; /* with an exact odometry, none do */
    memset(weighted, 0, sizeof(double) * s);
    for (Index e = 0; e < s; e++)
        if (gain[e] != 0.0) {
            moves = 1;
            for (Index a = 0; a < s; a++) weighted[a] += w->weight[a * s + e] * gain[e];
        }
    to->alone[j] = 1.0 / spread + (moves ? dot(gain, weighted, s) : 0.0);
    const Row row = row_of(of, walk, j);
    for (int t = 0; t < row.count; t++) {
        const Index a = row.at[t];
        const double h = row.by[t];
        w->adjoint[a] += h * to->multipliers[j];
        w->adjoint_limited[a] += h * to->own[j];
        add(w->by_unknowns + a * size, h, effect, size);
        if (!moves) continue;
        add(w->weight + a * s, -h, weighted, s);
        for (Index e = 0; e < s; e++) w->weight[e * s + a] -= h * weighted[e];
    }
    for (int t = 0; t < row.count; t++)
        for (int f = 0; f < row.count; f++)
            w->weight[row.at[t] * s + row.at[f]] += row.by[t] * row.by[f] * to->alone[j];
}

SIZED void shock_of(const Measured *of, const Walk *walk, Index i, Index k, Work *w, Step *to)
{
    const Index s = states(of), size = estimated(of), x = 3 * i;
    const double *move = walk->moves + 8 * (i * of->ticks + k);
    const double effects[2][3] = {{move[0], move[1], 0.0}, {move[4], move[5], of->period}};
    double *by[2] = {w->vector, w->other}, *shock = to->shocks + 5 * (i * of->ticks + k);
    for (Index e = 0; e < 2; e++) {
        shock[e] = 0.0;
        memset(w->effect, 0, sizeof(double) * size);
        for (Index a = 0; a < 2 + e; a++) {
            shock[e] += effects[e][a] * w->adjoint[x + a];
            add(w->effect, effects[e][a], w->by_unknowns + (x + a) * size, size);
        }
        whitened(w->whitening, size, w->effect, by[e]);
    }
    for (Index t = 0; t < 3; t++) {
        const Index e = t / 2, f = (t + 1) / 2;
        double information = 0.0;
        for (Index a = 0; a < 2 + e; a++)
            for (Index b = 0; b < 2 + f; b++)
                information += effects[e][a] * effects[f][b] * w->weight[(x + a) * s + x + b];
        shock[2 + t] = information - dot(by[e], by[f], size);
    }
}

SIZED void attributed(const Measured *of, const Walk *walk, Index i, Index k, Work *w, Step *to)
{
    const Index s = states(of), size = estimated(of), K = of->ticks, x = 3 * i, y = 3 * i + 1, h = 3 * i + 2;
    const double *move = walk->moves + 8 * (i * K + k);
    const double sx = move[0], sy = move[1], dx = move[2], dy = move[3], gx = move[4], gy = move[5];
    double *adjoint = w->adjoint, *limited = w->adjoint_limited, *by = w->by_unknowns, *weight = w->weight;
    const Index v = 2 * i * K + k, omega = (2 * i + 1) * K + k;
    to->white[v] = of->white[v] * (sx * limited[x] + sy * limited[y]);
    to->white[omega] = of->white[omega] * (gx * limited[x] + gy * limited[y] + of->period * limited[h]);
    adjoint[h] += -dy * adjoint[x] + dx * adjoint[y];
    limited[h] += -dy * limited[x] + dx * limited[y];
    add(by + h * size, -dy, by + x * size, size);
    add(by + h * size, dx, by + y * size, size);
    add(weight + h * s, -dy, weight + x * s, s);
    add(weight + h * s, dx, weight + y * s, s);
    for (Index a = 0; a < s; a++) {
        double *row = weight + a * s;
        row[h] += -dy * row[x] + dx * row[y];
    }
}

SIZED void backward(const Measured *of, const Walk *walk, Work *w, Step *to)
{
    const Index s = states(of), size = estimated(of);
    memset(w->adjoint, 0, sizeof(double) * s);
    memset(w->adjoint_limited, 0, sizeof(double) * s);
    memset(w->by_unknowns, 0, sizeof(double) * s * size);
    memset(w->weight, 0, sizeof(double) * s * s);
    for (Index k = of->ticks; k >= 0; k--) {
        for (Index j = of->begin[k + 1] - 1; j >= of->begin[k]; j--) {
            weighed_in(of, walk, j, w, to);
            whitened(w->whitening, size, w->effect, w->vector);
            to->explained[j] = dot(w->vector, w->vector, size);
        }
        if (k == 0) break;
        for (Index i = 0; i < of->robots; i++) {
            if (of->strays) shock_of(of, walk, i, k - 1, w, to);
            attributed(of, walk, i, k - 1, w, to);
        }
        for (Index a = 3 * of->robots; a < s; a++) {
            w->adjoint[a] *= of->decay;
            w->adjoint_limited[a] *= of->decay;
            scale(w->by_unknowns + a * size, of->decay, size);
            scale(w->weight + a * s, of->decay, s);
            for (Index e = 0; e < s; e++) w->weight[e * s + a] *= of->decay;
        }
    }
}

SIZED void slow_errors(const Measured *of, Work *w, Step *to)
{
    double *before = w->vector, *after = w->other;
    memset(to->slow, 0, sizeof(double) * of->ranges);
    if (!of->radios) return;
    memset(before, 0, sizeof(double) * of->radios);
    memset(after, 0, sizeof(double) * of->radios);
    for (Index k = 0; k <= of->ticks; k++) {
        for (Index j = of->begin[k]; j < of->begin[k + 1]; j++) {
            if (of->radio[j] < 0) continue;
            before[of->radio[j]] += to->own[j];
            to->slow[j] += of->slow * before[of->radio[j]];
        }
        scale(before, of->decay, of->radios);
    }
    for (Index k = of->ticks; k >= 0; k--) {
        for (Index j = of->begin[k + 1] - 1; j >= of->begin[k]; j--) {
            if (of->radio[j] < 0) continue;
            to->slow[j] += of->slow * after[of->radio[j]];
            after[of->radio[j]] += to->own[j];
        }
        scale(after, of->decay, of->radios);
    }
}

SIZED void ends_of(const Measured *of, Work *w, Step *to)
{
    const Index n3 = 3 * of->robots, s = states(of), q = unknowns(of), size = estimated(of);
    double *spread = w->vector, *effect = w->other, *by = w->by_unknowns;
    for (Index a = 0; a < n3; a++) whitened(w->whitening, size, w->u + a * q, by + a * size);
    memset(to->ends, 0, sizeof(double) * n3 * n3);
    for (Index c = 0; c < size; c++) {
        for (Index a = 0; a < n3; a++) effect[a] = by[a * size + c];
        for (Index a = 0; a < n3; a++) add(to->ends + a * n3, effect[a], effect, n3);
    }
    for (Index a = 0; a < n3; a++)
        for (Index e = 0; e < n3; e++) to->ends[a * n3 + e] += w->p[a * s + e];
    for (Index c = size; c < q; c++) {
        solved(w->lower, size, w->information + c * q, spread);
        for (Index a = 0; a < n3; a++) effect[a] = w->u[a * q + c] - dot(w->u + a * q, spread, size);
        for (Index a = 0; a < n3; a++) add(to->ends + a * n3, effect[a], effect, n3);
    }
}

SIZED int sized_step(
    const Measured *of, const Walk *walk, const double *poses, const double *variance, double ridge,
    double largest, Work *w, Step *to)
{
    const Index n3 = 3 * of->robots, q = unknowns(of), size = estimated(of);
    if (!forward(of, walk, poses, variance, 1, w)) return 0;
    for (Index a = 0; a < n3; a++) {
        double *own = w->information + a * q + a;
        *own += ridge + ridge * *own;
    }
    if (!cholesky(w->information, q, 0, size, w->effect, w->lower)) return 0;
    solved(w->lower, size, w->gradient, to->change);
    inverted(w->lower, size, w->vector, w->whitening, to->inverse);
    completed(w->lower, size, 0, n3, w->vector, to->inverse);
    if (!cholesky(to->inverse, size, 0, n3, w->effect, w->inner)) return 0;
    substituted(w->inner, n3, to->change, w->vector);
    const double length = sqrt(dot(w->vector, w->vector, n3));
    double of_start = 0.0;
    for (Index a = 0; a < n3; a++) of_start += 2.0 * log(w->inner[a * n3 + a]);
    if (!limited(of, largest, to->change, w, to->limited)) return 0;
    misfits(of, to->change, w, w->misfit);
    if (memcmp(to->change, to->limited, sizeof(double) * size)) misfits(of, to->limited, w, w->of_limited);
    else memcpy(w->of_limited, w->misfit, sizeof(double) * of->ranges);
    backward(of, walk, w, to);
    double volume = 0.0;
    for (Index j = 0; j < of->ranges; j++) volume += log(w->variance[j]);
    for (Index a = 0; a < size; a++) volume += 2.0 * log(w->lower[a * size + a]);
    slow_errors(of, w, to);
    ends_of(of, w, to);
    to->numbers[0] = chi2_of(of, poses, to->change, w);
    to->numbers[1] = length;
    to->numbers[2] = volume;
    to->numbers[3] = of_start;
    return 1;
}

/* Return what `call` returns with `of`, compiled once more for the sizes that most fits of missions have: a robot
   near its anchor, or two, with a bias and a scale of all ranges, a bias of each pair of radios, and the errors of
   the odometry. */
#define BY_SIZE(of, call)                                                                                   \
    Measured sized = *of;                                                                                   \
    of = &sized;                                                                                            \
    if (sized.constant == 3 && !sized.anchors && !sized.radios && sized.robots == 2 && sized.common == 5) { \
        sized.robots = 2, sized.common = 5, sized.constant = 3, sized.anchors = sized.radios = 0;           \
        return call;                                                                                        \
    }                                                                                                       \
    if (sized.constant == 3 && !sized.anchors && !sized.radios && sized.robots == 1 && sized.common == 3) { \
        sized.robots = 1, sized.common = 3, sized.constant = 3, sized.anchors = sized.radios = 0;           \
        return call;                                                                                        \
    }                                                                                                       \
    return call;

CLONED static int loosened(
    const Measured *of, const Walk *walk, const double *poses, const double *variance, Work *w, double *found)
{
    BY_SIZE(of, sized_loosened(of, walk, poses, variance, w, found))
}

/* smoother.step. Returns 0 if the information of the unknowns is not positive definite. */
CLONED static int stepping(
    const Measured *of, const Walk *walk, const double *poses, const double *variance, double ridge,
    double largest, Work *w, Step *to)
{
    BY_SIZE(of, sized_step(of, walk, poses, variance, ridge, largest, w, to))
}

/* Add to the inverse of a step, which is that of the start poses, the columns of all other unknowns. */
CLONED static void finished(const Measured *of, Work *w, Step *to)
{
    const Index size = estimated(of);
    completed(w->lower, size, 3 * of->robots, size, w->vector, to->inverse);
}

/* --- weights of ranges ------------------------------------------------------------------------------ */

static void weighted_variance(const Measured *of, const Weighing *by, const double *weights, double *to)
{
    for (Index j = 0; j < of->ranges; j++) {
        const double least = by->sigma[j] / (FAR * by->longest);
        to[j] = by->sigma[j] * by->sigma[j] / larger(weights[j], least * least);
    }
}

/* The element that would be at `place` of the sorted `values`, which change their places. */
static double selected(double *values, Index count, Index place)
{
    Index low = 0, high = count - 1;
    while (low < high) {
        const double pivot = values[place];
        Index i = low, j = high;
        do {
            while (values[i] < pivot) i++;
            while (pivot < values[j]) j--;
            if (i <= j) {
                const double value = values[i];
                values[i++] = values[j];
                values[j--] = value;
            }
        } while (i <= j);
        if (j < place) low = i;
        if (place < i) high = j;
    }
    return values[place];
}

static double log_sum(double one, double other)
{
    const double most = larger(one, other), least = smaller(one, other);
    return most + log1p(exp(least - most));
}

static double inlier_probability(double error, double sigma, const Weighing *by)
{
    const double in_sigmas = error / sigma, width = by->most - by->least;
    const double misfit = 0.5 * in_sigmas * in_sigmas;
    const double beyond = (error - smaller(larger(error, by->least), by->most)) / sigma;
    const double wide = log(sigma / larger(width, sigma)) + (by->outlier - by->inlier);
    const double ratio = log_sum(misfit - 0.5 * beyond * beyond + wide, misfit + (by->stray - by->inlier));
    return 1.0 / (1.0 + exp(smaller(ratio, LARGEST_RATIO)));
}

double weights_by_errors(
    const Weighing *by, Index count, const double *errors, const double *sigma, double *ratios, double *to)
{
    double scale = 1.0;
    for (Index j = 0; j < count; j++) {
        to[j] = 1.0;
        ratios[j] = fabs(errors[j] / sigma[j]);
    }
    if (!by->robust || count == 0) return scale;
    if (by->degrees != 0.0) scale = larger(1.0, selected(ratios, count, count / 2) / MEDIAN);
    for (Index j = 0; j < count; j++)
        if (!by->holding[j]) to[j] = inlier_probability(errors[j], scale * sigma[j], by);
    return scale;
}

static double inlier_probabilities(
    const Measured *of, const Weighing *by, const Step *step, const double *variance, Work *w, double *to)
{
    for (Index j = 0; j < of->ranges; j++) {
        const double precision = larger(step->alone[j] - step->explained[j], BLIND * step->alone[j]);
        w->errors[j] = step->multipliers[j] / precision;
        w->spread[j] = sqrt(larger(1.0 / precision - variance[j], 0.0) + by->sigma[j] * by->sigma[j]);
    }
    return weights_by_errors(by, of->ranges, w->errors, w->spread, w->ratios, to);
}

static double outlier_log_density(
    const Measured *of, const Weighing *by, const double *residuals, const double *weights, Work *w)
{
    double total = 0.0;
    const double soft = by->outlier > -INFINITY ? SOFT * by->least : 0.0;
    weighted_variance(of, by, weights, w->spread);
    for (Index j = 0; j < of->ranges; j++) {
        if (weights[j] > INLIER) continue;
        const double sigma = larger(by->sigma[j], soft);
        const double off = larger(larger(by->least - residuals[j], residuals[j] - by->most), 0.0) / sigma;
        const double wide = by->outlier - log(larger(by->most - by->least, sigma));
        total += 0.5 * log(w->spread[j]);
        total += log_sum(wide - 0.5 * off * off, by->stray - log(sigma));
    }
    return total;
}

static Index inliers(const Measured *of, const double *weights)
{
    Index count = 0;
    for (Index j = 0; j < of->ranges; j++) count += weights[j] > INLIER;
    return count;
}

/* --- strays of the odometry ------------------------------------------------------------------------- */

static void weighted_noise(const Measured *of, const double *sound, double *to)
{
    const Index K = of->ticks;
    for (Index e = 0; e < 2 * of->robots * K; e++) {
        const double share = sound[e / (2 * K) * K + e % K], least = of->white[e], most = of->stray[e];
        to[e] = share * least + (1.0 - share) * most;
    }
}

static void sound_by_errors(const Measured *of, const Weighing *by, const double *white, double *to)
{
    const Index K = of->ticks;
    for (Index tick = 0; tick < of->robots * K; tick++) {
        const Index begin = tick / K * 2 * K + tick % K;
        double ratio = by->astray_ratio;
        for (Index e = begin; e <= begin + K; e += K) {
            const double least = of->white[e], most = of->stray[e];
            const double usual = (1.0 - by->astray) * least + by->astray * most;
            if (most > least) ratio += 0.5 * white[e] * white[e] * (1.0 / usual - 1.0 / most);
        }
        to[tick] = 1.0 / (1.0 + exp(smaller(ratio, LARGEST_RATIO)));
    }
}

static void others_of(const double *shock, double v, double omega, double to[5])
{
    const double by_v = shock[0], by_omega = shock[1], vv = shock[2], mixed = shock[3], both = shock[4];
    const double left_v = 1.0 - vv * v, left_omega = 1.0 - both * omega;
    const double determinant = left_v * left_omega - mixed * omega * mixed * v;
    memset(to, 0, 5 * sizeof(double));
    if (!(determinant > 0.0)) return;
    to[0] = (left_omega * by_v + mixed * omega * by_omega) / determinant;
    to[1] = (mixed * v * by_v + left_v * by_omega) / determinant;
    to[2] = (left_omega * vv + mixed * omega * mixed) / determinant;
    to[3] = mixed / determinant;
    to[4] = (mixed * v * mixed + left_v * both) / determinant;
}

static double evidence_of(const double others[5], double v, double omega, double scale)
{
    const double by_v = others[0], by_omega = others[1], mixed = others[3];
    const double a = 1.0 + v * others[2], b = v * mixed, c = omega * mixed, d = 1.0 + omega * others[4];
    const double determinant = a * d - b * c;
    const double of_v = d * v * by_v - b * omega * by_omega, of_omega = a * omega * by_omega - c * v * by_v;
    return 0.5 * (by_v * of_v + by_omega * of_omega) / determinant / (scale * scale) - 0.5 * log(determinant);
}

static void sound_probabilities(
    const Measured *of, const Weighing *by, const double *before, const double *shocks, const double *white,
    double scale, double *to)
{
    const Index K = of->ticks;
    double others[5];
    for (Index tick = 0; tick < of->robots * K; tick++) {
        const Index v = tick / K * 2 * K + tick % K, omega = v + K;
        to[tick] = 1.0;
        if (!(of->stray[v] > of->white[v] || of->stray[omega] > of->white[omega])) continue;
        others_of(shocks + 5 * tick, white[v], white[omega], others);
        const double ratio = by->astray_ratio + evidence_of(others, of->stray[v], of->stray[omega], scale)
            - evidence_of(others, of->white[v], of->white[omega], scale);
        to[tick] = 0.5 * (before[tick] + 1.0 / (1.0 + exp(smaller(ratio, LARGEST_RATIO))));
    }
}

/* Let the noise of the odometry of `of` be that by the weights of the ticks of a fit. */
static void weigh(const Measured *told, Work *w, const Fitted *by, Measured *of)
{
    *of = *told;
    if (!told->strays) return;
    weighted_noise(told, by->sound, w->noise);
    of->white = w->noise;
}

/* --- the noise level -------------------------------------------------------------------------------- */

static double noise_level(double chi2, Index degrees, double nu, double correlation)
{
    if (nu == 0.0) return 1.0;
    const double worth = (1.0 - correlation) / (1.0 + correlation), n = degrees > 0 ? (double)degrees : 0.0;
    return larger((nu + worth * chi2) / (nu + worth * n), LEAST_LEVEL) / worth;
}

static double residual_correlation(
    const Measured *of, const Weighing *by, const double *own, const double *weights, double level)
{
    double power = 0.0, neighbours = 0.0, before = 0.0;
    for (Index r = 0; r < of->ranges; r++) {
        const Index j = by->by_radio[r];
        const double scaled = weights[j] > INLIER ? own[j] / by->sigma[j] : 0.0;
        power += scaled * scaled;
        if (r > 0 && of->radio[j] == of->radio[by->by_radio[r - 1]]) neighbours += scaled * before;
        before = scaled;
    }
    if (!(power > ROUNDED * (double)of->ranges)) return 0.0;
    const double found = neighbours / power - BY_CHANCE * smaller(level, 1.0) / sqrt((double)of->ranges);
    return smaller(larger(found, 0.0), MOST_CORRELATED);
}

/* --- the loop of a fit ------------------------------------------------------------------------------ */

/* Set what follows from the poses and the errors of a point. */
static void predicted(const Measured *of, Point *at)
{
    const Index n3 = 3 * of->robots, c = of->common;
    double cost = 0.0;
    walked(of, at->poses, at->constant, at->white, at->common + (of->deep < 0 ? 0 : of->deep), &at->walk);
    for (Index e = 0; e < c; e++) cost += at->common[e] * at->common[e];
    for (Index e = 0; e < of->robots * of->constant; e++) cost += at->constant[e] * at->constant[e];
    for (Index e = 0; e < 2 * of->robots * of->ticks; e++)
        cost += at->white[e] * at->white[e] / larger(of->white[e], LEAST_VARIANCE);
    for (Index a = 0; a < n3; a++) {
        double told = 0.0;
        for (Index e = 0; e < n3; e++) told += of->information[a * n3 + e] * (of->mean[e] - at->poses[e]);
        cost += (of->mean[a] - at->poses[a]) * told;
    }
    for (Index j = 0; j < of->ranges; j++) {
        double left = at->walk.residual[j];
        cost += at->slow[j] * at->of_slow[j];
        for (Index e = 0; e < c; e++) left -= effect_of(of, &at->walk, j, e) * at->common[e];
        at->own[j] = left - at->slow[j];
    }
    *at->prior_cost = cost;
}

static double cost_of(const Measured *of, const Point *at, const double *variance)
{
    double total = *at->prior_cost;
    for (Index j = 0; j < of->ranges; j++) total += at->own[j] * at->own[j] / variance[j];
    return total;
}

/* The start poses with the pivots in the robots' frames instead of the positions. */
void guess(const Measured *of, const double *poses, double *to)
{
    for (Index a = 0; a < 3 * of->robots; a += 3) {
        const double heading = poses[a + 2], c = cos(heading), s = sin(heading);
        double x = of->pivot[a / 3 * 2] - poses[a], y = of->pivot[a / 3 * 2 + 1] - poses[a + 1];
        if (isnan(x)) x = y = 0.0;
        to[a] = c * x + s * y;
        to[a + 1] = c * y - s * x;
        to[a + 2] = heading;
    }
}

static void moved_poses(const Measured *of, const double *poses, const double *change, double *to)
{
    guess(of, poses, to);
    for (Index a = 0; a < 3 * of->robots; a += 3) {
        const double mx = to[a] + change[a], my = to[a + 1] + change[a + 1], heading = to[a + 2] + change[a + 2];
        const int pivoted = !isnan(of->pivot[a / 3 * 2]);
        const double x = pivoted ? of->pivot[a / 3 * 2] : poses[a];
        const double y = pivoted ? of->pivot[a / 3 * 2 + 1] : poses[a + 1];
        const double c = cos(heading), s = sin(heading);
        to[a] = x - (c * mx - s * my);
        to[a + 1] = y - (s * mx + c * my);
        to[a + 2] = heading;
    }
}

static void between(const double *one, const double *other, double fraction, Index count, double *to)
{
    for (Index e = 0; e < count; e++)
        to[e] = fraction < 1.0 ? one[e] + fraction * (other[e] - one[e]) : other[e];
}

static void after_step(
    const Measured *of, const Point *at, const Step *step, double fraction, Work *w, Point *to)
{
    const Index n3 = 3 * of->robots, c = of->common;
    for (Index a = 0; a < n3; a++) w->shorter[a] = fraction * step->limited[a];
    moved_poses(of, at->poses, w->shorter, to->poses);
    between(at->common, step->limited + n3, fraction, c, to->common);
    between(at->constant, step->limited + n3 + c, fraction, of->robots * of->constant, to->constant);
    between(at->white, step->white, fraction, 2 * of->robots * of->ticks, to->white);
    between(at->slow, step->slow, fraction, of->ranges, to->slow);
    between(at->of_slow, step->own, fraction, of->ranges, to->of_slow);
    predicted(of, to);
}

/* Returns 0 if no fraction of the step descends: then there is no point after it. */
static int stepped(const Measured *of, const Point *at, const Step *step, const double *variance, Work *w,
                   Point *to)
{
    const double most = cost_of(of, at, variance) + DESCENT;
    for (size_t t = 0; t < sizeof SHORTER_STEPS / sizeof *SHORTER_STEPS; t++) {
        after_step(of, at, step, SHORTER_STEPS[t], w, to);
        if (cost_of(of, to, variance) <= most) return 1;
    }
    return 0;
}

static double off_model(
    const Measured *of, const Point *at, const Step *step, const double *variance, double level)
{
    return sqrt(larger(cost_of(of, at, variance) - step->numbers[0], 0.0) / level);
}

/* Returns 0 if the unknowns have no solution that is finite. */
static int step_of(const Measured *of, const Weighing *by, const Point *at, Work *w, Fitted *to)
{
    const double largest = LARGEST_STEP * by->longest;
    return stepping(of, &at->walk, at->poses, to->variance, RIDGE, largest, w, &to->step)
        && isfinite(to->step.numbers[0]);
}

static void ended(
    const Measured *of, const Weighing *by, Index model, Index final, double last_step, Work *w, Fitted *to)
{
    const Index count = inliers(of, to->weights);
    finished(of, w, &to->step);
    double level = noise_level(to->step.numbers[0], count - by->free, by->degrees, 0.0);
    if (by->degrees != 0.0) {
        const double correlation =
            residual_correlation(of, by, to->points[final].own, to->weights, level);
        level = noise_level(to->step.numbers[0], count - by->free, by->degrees, correlation);
    }
    to->numbers[0] = last_step;
    to->numbers[1] = level;
    to->numbers[2] = (double)count;
    to->numbers[3] = outlier_log_density(of, by, to->points[final].walk.residual, to->weights, w);
    to->numbers[4] = (double)model;
    to->numbers[5] = (double)final;
}

/* The fit that begins at the poses and errors of the first of `points`; unless `weighed`, its weights follow
   from the residuals there. Returns 0 if it is singular. */
static int converged(
    const Measured *told, const Weighing *by, const Convergence *until, int weighed, Work *w, Fitted *to)
{
    const Index ticks = told->strays * told->robots * told->ticks;
    Measured by_sound;
    const Measured *of = &by_sound;
    Index at = 0;
    double before = 0.0, least = 0.0;
    if (told->strays) sound_by_errors(told, by, to->points->white, to->sound);
    weigh(told, w, to, &by_sound);
    predicted(of, to->points);
    for (Index j = 0; j < of->ranges; j++) w->updated[j] = by->sigma[j] * by->sigma[j];
    if (!loosened(of, &to->points->walk, to->points->poses, w->updated, w, w->spread)) return 0;
    for (Index j = 0; j < of->ranges; j++) {
        least = j > 0 ? larger(least, w->spread[j]) : w->spread[j];
        w->spread[j] = sqrt(w->spread[j]);
    }
    least = by->noisy ? GRAIN * least : 0.0;
    if (!weighed)
        weights_by_errors(by, of->ranges, to->points->walk.residual, w->spread, w->ratios, to->weights);
    for (Index j = 0; j < of->ranges; j++) w->changed[j] = 0.0, w->damping[j] = 1.0;
    for (Index number = 0; number <= until->steps; number++) {
        const Point *here = to->points + at;
        weighted_variance(of, by, to->weights, to->variance);
        for (Index j = 0; j < of->ranges; j++) to->variance[j] += least;
        if (!step_of(of, by, here, w, to)) return 0;
        const double scale = inlier_probabilities(of, by, &to->step, to->variance, w, w->updated);
        if (told->strays) sound_probabilities(told, by, to->sound, to->step.shocks, of->white, scale, w->sound);
        const Index freedom = inliers(of, to->weights) - by->free;
        const double level = noise_level(to->step.numbers[0], freedom, by->degrees, 0.0);
        const double length = to->step.numbers[1] / sqrt(level);
        if (number == 0) before = length / until->decrease;
        const double expected = length * length / larger(larger(length, before), LAST_STEP);
        if (number == until->steps) {
            const double off = off_model(of, here, &to->step, to->variance, level);
            ended(of, by, at, at, off > 1.0 ? off : length, w, to);
            return 1;
        }
        const Index after = stepped(of, here, &to->step, to->variance, w, to->points + 1 - at) ? 1 - at : at;
        int still = number > 0 || until->decrease < 1.0 || !by->noisy;
        for (Index j = 0; j < of->ranges; j++)
            still = still && fabs(w->updated[j] - to->weights[j]) < SETTLED_WEIGHT;
        for (Index e = 0; e < ticks; e++) still = still && fabs(w->sound[e] - to->sound[e]) < SETTLED_WEIGHT;
        if (still && expected < until->shortest
            && off_model(of, to->points + after, &to->step, to->variance, level) <= 1.0) {
            ended(of, by, at, after, expected, w, to);
            return 1;
        }
        for (Index j = 0; j < of->ranges; j++) {
            const double change = w->updated[j] - to->weights[j];
            if (number > 1 && change * w->changed[j] < 0.0) w->damping[j] *= WEIGHT_DAMPING;
            w->changed[j] = change;
            to->weights[j] += w->damping[j] * change;
        }
        before = length;
        at = after;
        if (!told->strays) continue;
        memcpy(to->sound, w->sound, sizeof(double) * ticks);
        weigh(told, w, to, &by_sound);
        predicted(of, to->points + at);
    }
    return 0;
}

/* The fit after full steps from the first of `points`, with the weights there. Returns 0 if it is singular. */
static int holding(const Measured *told, const Weighing *by, Index steps, Work *w, Fitted *to)
{
    Measured by_sound;
    const Measured *of = &by_sound;
    Index at = 0;
    if (told->strays) sound_by_errors(told, by, to->points->white, to->sound);
    weigh(told, w, to, &by_sound);
    predicted(of, to->points);
    for (Index number = 0;; number++, at = 1 - at) {
        Point *here = to->points + at, *next = to->points + 1 - at;
        weighted_variance(of, by, to->weights, to->variance);
        if (!step_of(of, by, here, w, to)) return 0;
        if (number == steps) break;
        after_step(of, here, &to->step, 1.0, w, next);
        if (number > 0) {
            inlier_probabilities(of, by, &to->step, to->variance, w, to->weights);
            continue;
        }
        for (Index j = 0; j < of->ranges; j++) {
            double spread = by->sigma[j] * by->sigma[j];
            for (Index e = 0; e < of->common; e++) {
                const double effect = effect_of(of, &next->walk, j, e);
                spread += effect * effect;
            }
            w->spread[j] = sqrt(spread);
        }
        weights_by_errors(by, of->ranges, next->walk.residual, w->spread, w->ratios, to->weights);
    }
    ended(of, by, at, at, to->step.numbers[1], w, to);
    return 1;
}

/* --- the memory --------------------------------------------------------------------------------------- */

#define POINT 16
#define STEP 12
#define ARRAYS (2 * POINT + STEP + 4)

/* Let consecutive pointers from `to` on have parts of `memory`; returns its end. */
static double *placed(double **to, double *memory, const Index *sizes, int count)
{
    for (int i = 0; i < count; i++) to[i] = memory, memory += sizes[i];
    return memory;
}

/* Set the sizes of the arrays of a fit, in their order; returns how many elements all have. */
static Index sizes_of(const Measured *of, Index sizes[ARRAYS])
{
    const Index n = of->robots, n3 = 3 * n, K = of->ticks, N = of->ranges, c = of->common;
    const Index size = estimated(of), ticks = of->strays * n * K;
    const Index point[POINT] = {
        n3, c, n * of->constant, 2 * n * K, N, N, n3 * (K + 1), 8 * n * K, 2 * N, N, N, N, N, N, N, 1};
    const Index rest[] = {
        size, size, size * size, 2 * n * K, N, N, N, N, N, n3 * n3, 5 * ticks, 4, N, N, ticks, 6};
    memcpy(sizes, point, sizeof point);
    memcpy(sizes + POINT, point, sizeof point);
    memcpy(sizes + 2 * POINT, rest, sizeof rest);
    Index all = 0;
    for (int i = 0; i < ARRAYS; i++) all += sizes[i];
    return all;
}

/* Set the workspace; returns its memory, which the caller frees, or NULL if there is none. */
static double *workspace(const Measured *of, Work *to)
{
    const Index n3 = 3 * of->robots, s = states(of), q = unknowns(of), size = estimated(of), N = of->ranges;
    const Index longest = q > of->radios ? q : of->radios, ticks = of->strays * of->robots * of->ticks;
    const Index sizes[] = {
        N, N, N * q, N * s, s, s * q, s * s, q * q, q, N, N, s, s, s * size, s * s, s, size,
        size * size, size * size, size * size, longest, longest, N, N, N, N, N, N, n3, ticks, 2 * ticks};
    const int count = sizeof sizes / sizeof *sizes;
    Index all = 0;
    for (int i = 0; i < count; i++) all += sizes[i];
    double *memory = malloc(sizeof(double) * (all + 1));
    if (memory) placed((double **)to, memory, sizes, count);
    return memory;
}

/* Find the arrays of `of` and `by` in consecutive `floats` and `numbers`, and set the ends of those of a fit. */
void prepared(Measured *of, Weighing *by, const double *floats, const Index *numbers, Index ends[ARRAYS])
{
    const Index n = of->robots, K = of->ticks, N = of->ranges, white = 2 * n * K;
    const Index of_floats[] = {n * K, n * K, n * K, white, of->strays * white, of->constant * white, 2 * N, N,
                               N * of->common, 3 * n, 9 * n * n, 2 * n};
    const double **to = &of->v;
    for (size_t i = 0; i < sizeof of_floats / sizeof *of_floats; i++) to[i] = floats, floats += of_floats[i];
    by->sigma = floats;
    of->begin = numbers;
    of->first = of->begin + K + 2;
    of->second = of->first + N;
    of->observer = of->second + N;
    of->anchor = of->observer + N;
    of->radio = of->anchor + N;
    by->holding = of->radio + N;
    by->by_radio = by->holding + N;
    sizes_of(of, ends);
    for (int i = 1; i < ARRAYS; i++) ends[i] += ends[i - 1];
}

/* The paths, in the order of Walk. */
void paths(
    const Measured *of, const double *poses, const double *constants, const double *white,
    const double *deep, double *to)
{
    Index sizes[ARRAYS];
    Walk walk;
    sizes_of(of, sizes);
    placed((double **)&walk, to, sizes + 6, 8);
    walked(of, poses, constants, white, deep, &walk);
}

/* A step; returns 0 if the information of the unknowns is not positive definite, and -2 without memory. */
int gauss_newton_step(const Measured *of, double *walk, const double *poses, const double *variance,
                      double ridge, double largest, double *memory)
{
    Index sizes[ARRAYS];
    Walk from;
    Step to;
    Work w;
    sizes_of(of, sizes);
    placed((double **)&from, walk, sizes + 6, 8);
    placed((double **)&to, memory, sizes + 2 * POINT, STEP);
    double *space = workspace(of, &w);
    if (!space) return NO_MEMORY;
    const int found = stepping(of, &from, poses, variance, ridge, largest, &w, &to);
    if (found) finished(of, &w, &to);
    free(space);
    return found;
}

/* The fit in `memory`, which has the start; until it has converged, or after a number of `steps` if a range holds a
   coordinate. Returns 0 if it is singular, and -2 without memory. */
int fitted(const Measured *of, const Weighing *by, const Convergence *until, int weighed, double *memory)
{
    Index sizes[ARRAYS];
    Fitted to;
    Work w;
    sizes_of(of, sizes);
    placed((double **)&to, memory, sizes, ARRAYS);
    double *space = workspace(of, &w);
    if (!space) return NO_MEMORY;
    const int found = until->shortest < 0.0 ? holding(of, by, until->steps, &w, &to)
                                            : converged(of, by, until, weighed, &w, &to);
    free(space);
    return found;
}
