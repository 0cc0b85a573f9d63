/* The functions of smoother.py, which explains them, in the same order and with the same operations.

   Matrices are stored row by row. Compile without contraction of products and sums (-ffp-contract=off) and
   without fast math: results then follow from this text and from the functions of the C library alone. */

#include <math.h>
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

typedef long long Index;

/* smoother.Measured: first the numbers, then the arrays. */
typedef struct {
    Index robots, ticks, ranges, common, constant, anchors, radios, scaled, delayed;
    double period, survey, slow, decay, scale;
    const double *v, *omega, *slip, *white, *patterns, *place, *rho, *effects, *mean, *information, *pivot;
    const Index *begin, *first, *second, *anchor, *radio;
} Measured;

/* smoother.Walk */
typedef struct {
    double *place, *moves, *direction, *residual, *rate;
} Walk;

/* smoother.Passed and smoother.Told; `row_of` has the places and derivatives of a range. */
typedef struct {
    double *innovation, *variance, *effects, *gain, *state, *u, *p, *information, *gradient;
    double *told, *by_unknowns, *weight, *weighted, *effect, *lower, *inner, *vector, *other;
} Work;

/* smoother.Step */
typedef struct {
    double *change, *limited, *inverse, *white, *own, *slow, *multipliers, *alone, *explained, *ends, *numbers;
} Step;

typedef struct {
    Index at[5];
    double by[5];
    int count;
} Row;

/* --- linear algebra --------------------------------------------------------------------------------- */

static void add(double *to, double factor, const double *what, Index count)
{
    for (Index e = 0; e < count; e++) to[e] += factor * what[e];
}

static void scale(double *vector, double factor, Index count)
{
    for (Index e = 0; e < count; e++) vector[e] *= factor;
}

static double dot(const double *one, const double *other, Index count)
{
    double total = 0.0;
    for (Index e = 0; e < count; e++) total += one[e] * other[e];
    return total;
}

/* `matrix` has rows of `width` elements, and `lower` of `end - begin`. Returns 0 if it is not positive. */
static int cholesky(const double *matrix, Index width, Index begin, Index end, double *lower)
{
    const Index size = end - begin;
    memset(lower, 0, sizeof(double) * size * size);
    for (Index a = 0; a < size; a++)
        for (Index e = 0; e <= a; e++) {
            double left = matrix[(begin + a) * width + begin + e] - dot(lower + a * size, lower + e * size, e);
            if (e < a) lower[a * size + e] = left / lower[e * size + e];
            else if (left > 0.0) lower[a * size + a] = sqrt(left);
            else return 0;
        }
    return 1;
}

static void substituted(const double *lower, Index size, const double *right, double *found)
{
    for (Index a = 0; a < size; a++)
        found[a] = (right[a] - dot(lower + a * size, found, a)) / lower[a * size + a];
}

static void solved(const double *lower, Index size, const double *right, double *found)
{
    substituted(lower, size, right, found);
    for (Index a = size - 1; a >= 0; a--) {
        found[a] /= lower[a * size + a];
        add(found, -found[a], lower + a * size, a);
    }
}

static void inverted(const double *lower, Index size, double *right, double *column, double *inverse)
{
    memset(right, 0, sizeof(double) * size);
    for (Index e = 0; e < size; e++) {
        right[e] = 1.0;
        solved(lower, size, right, column);
        right[e] = 0.0;
        for (Index a = 0; a <= e; a++) inverse[a * size + e] = inverse[e * size + a] = column[a];
    }
}

/* --- sizes ------------------------------------------------------------------------------------------ */

static Index states(const Measured *of) { return 3 * of->robots + of->radios; }

static Index estimated(const Measured *of) { return 3 * of->robots + of->common + of->robots * of->constant; }

static Index unknowns(const Measured *of) { return estimated(of) + 2 * of->anchors; }

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

void walked(const Measured *of, const double *poses, const double *constants, const double *white, Walk *to)
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
        for (Index j = of->begin[k]; j < of->begin[k + 1]; j++) {
            const double *at = to->place + 3 * (of->first[j] * (K + 1) + k), *other = of->place + 2 * j;
            if (of->second[j] >= 0) other = to->place + 3 * (of->second[j] * (K + 1) + k);
            const double dx = at[0] - other[0], dy = at[1] - other[1];
            double distance = sqrt(dx * dx + dy * dy);
            if (distance < SMALLEST_DISTANCE) distance = SMALLEST_DISTANCE;
            to->direction[2 * j] = dx / distance;
            to->direction[2 * j + 1] = dy / distance;
            to->residual[j] = of->rho[j] - distance;
            to->rate[j] = 0.0;
            if (of->delayed >= 0 && k > 0) {
                double by[2], of_other[2];
                velocity_of(of, to, of->first[j], k, by);
                if (of->second[j] >= 0) {
                    velocity_of(of, to, of->second[j], k, of_other);
                    by[0] -= of_other[0];
                    by[1] -= of_other[1];
                }
                to->rate[j] = to->direction[2 * j] * by[0] + to->direction[2 * j + 1] * by[1];
            }
        }
}

/* The derivatives of the start pose of robot `i` with respect to its unknowns. */
static void basis_of(const Measured *of, const double *poses, Index i, double by[3][3])
{
    double x = poses[3 * i] - of->pivot[2 * i], y = poses[3 * i + 1] - of->pivot[2 * i + 1];
    if (isnan(x)) x = y = 0.0;
    const double c = cos(poses[3 * i + 2]), s = sin(poses[3 * i + 2]);
    const double rows[3][3] = {{-c, s, -y}, {-s, -c, x}, {0.0, 0.0, 1.0}};
    memcpy(by, rows, sizeof rows);
}

/* --- the forward pass ------------------------------------------------------------------------------- */

static void moved(const Measured *of, const Walk *walk, Index i, Index k, Work *w)
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

static void decayed(const Measured *of, Work *w)
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

static Row row_of(const Measured *of, const Walk *walk, Index j)
{
    const double x = walk->direction[2 * j], y = walk->direction[2 * j + 1];
    Row row = {{3 * of->first[j], 3 * of->first[j] + 1}, {x, y}, 2};
    if (of->second[j] >= 0) {
        row.at[2] = 3 * of->second[j]; row.by[2] = -x;
        row.at[3] = 3 * of->second[j] + 1; row.by[3] = -y;
        row.count = 4;
    }
    if (of->radios && of->radio[j] >= 0) {
        row.at[row.count] = 3 * of->robots + of->radio[j];
        row.by[row.count] = 1.0;
        row.count++;
    }
    return row;
}

/* Returns 0 if rounding has left no variance. */
static int measured(const Measured *of, const Walk *walk, Index j, double variance, Work *w)
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
    for (Index e = 0; e < of->common; e++) {
        const double by_scale = of->scale * (of->rho[j] - walk->residual[j]);
        double told = of->effects[j * of->common + e];
        if (e == of->delayed) told = -told * walk->rate[j];
        effect[3 * of->robots + e] += e == of->scaled && told != 0.0 ? by_scale : told;
    }
    if (of->anchor[j] >= 0)
        for (Index e = 0; e < 2; e++)
            effect[size + 2 * of->anchor[j] + e] -= of->survey * walk->direction[2 * j + e];
    for (int t = 0; t < row.count; t++) variance += row.by[t] * gain[row.at[t]];
    w->innovation[j] = innovation;
    w->variance[j] = variance;
    return variance > 0.0;
}

static void updated(const Measured *of, Index j, Work *w)
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
static void begun(const Measured *of, const double *poses, Work *w)
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

static int forward(
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

int loosened(
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

static int limited(const Measured *of, double largest, const double *change, Work *w, double *found)
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
    if (!cholesky(w->information, q, n3, size, w->inner)) return 0;
    solved(w->inner, size - n3, w->vector, found + n3);
    return 1;
}

static double chi2_of(const Measured *of, const double *poses, const double *change, Work *w)
{
    const Index n3 = 3 * of->robots, q = unknowns(of), size = estimated(of);
    double chi2 = 0.0, by[3][3], *off = w->vector;
    for (Index j = 0; j < of->ranges; j++) {
        const double misfit = w->innovation[j] - dot(w->effects + j * q, change, size);
        chi2 += misfit * misfit / w->variance[j];
    }
    chi2 += dot(change + n3, change + n3, size - n3);
    for (Index i = 0; i < n3; i += 3) {
        basis_of(of, poses, i / 3, by);
        for (Index a = 0; a < 3; a++) off[i + a] = of->mean[i + a] - poses[i + a] - dot(by[a], change + i, 3);
    }
    for (Index a = 0; a < n3; a++) chi2 += off[a] * dot(of->information + a * n3, off, n3);
    return chi2;
}

static double told_by(const Measured *of, const Walk *walk, Index j, Work *w, double *precision)
{
    const Index s = states(of), q = unknowns(of), size = estimated(of);
    const double *gain = w->gain + j * s, spread = w->variance[j];
    const double here = w->innovation[j] / spread - dot(gain, w->told, s);
    double *effect = w->effect, *weighted = w->weighted;
    for (Index e = 0; e < size; e++) effect[e] = w->effects[j * q + e] / spread;
    for (Index a = 0; a < s; a++) add(effect, -gain[a], w->by_unknowns + a * size, size);
    for (Index a = 0; a < s; a++) weighted[a] = dot(w->weight + a * s, gain, s);
    *precision = 1.0 / spread + dot(gain, weighted, s);
    const Row row = row_of(of, walk, j);
    for (int t = 0; t < row.count; t++) {
        const Index a = row.at[t];
        const double h = row.by[t];
        w->told[a] += h * here;
        add(w->by_unknowns + a * size, h, effect, size);
        add(w->weight + a * s, -h, weighted, s);
        for (Index e = 0; e < s; e++) w->weight[e * s + a] -= h * weighted[e];
    }
    for (int t = 0; t < row.count; t++)
        for (int f = 0; f < row.count; f++)
            w->weight[row.at[t] * s + row.at[f]] += row.by[t] * row.by[f] * *precision;
    return here;
}

static void attributed(const Measured *of, const Walk *walk, Index i, Index k, Work *w, Step *to)
{
    const Index s = states(of), size = estimated(of), K = of->ticks, x = 3 * i, y = 3 * i + 1, h = 3 * i + 2;
    const double *move = walk->moves + 8 * (i * K + k);
    const double sx = move[0], sy = move[1], dx = move[2], dy = move[3], gx = move[4], gy = move[5];
    double *told = w->told, *by = w->by_unknowns, *weight = w->weight;
    const double of_x = told[x] - dot(by + x * size, to->limited, size);
    const double of_y = told[y] - dot(by + y * size, to->limited, size);
    const double of_h = told[h] - dot(by + h * size, to->limited, size);
    const Index v = 2 * i * K + k, omega = (2 * i + 1) * K + k;
    to->white[v] = of->white[v] * (sx * of_x + sy * of_y);
    to->white[omega] = of->white[omega] * (gx * of_x + gy * of_y + of->period * of_h);
    told[h] += -dy * told[x] + dx * told[y];
    add(by + h * size, -dy, by + x * size, size);
    add(by + h * size, dx, by + y * size, size);
    add(weight + h * s, -dy, weight + x * s, s);
    add(weight + h * s, dx, weight + y * s, s);
    for (Index a = 0; a < s; a++) {
        double *row = weight + a * s;
        row[h] += -dy * row[x] + dx * row[y];
    }
}

static void backward(const Measured *of, const Walk *walk, Work *w, Step *to)
{
    const Index s = states(of), size = estimated(of);
    memset(w->told, 0, sizeof(double) * s);
    memset(w->by_unknowns, 0, sizeof(double) * s * size);
    memset(w->weight, 0, sizeof(double) * s * s);
    for (Index k = of->ticks; k >= 0; k--) {
        for (Index j = of->begin[k + 1] - 1; j >= of->begin[k]; j--) {
            const double here = told_by(of, walk, j, w, to->alone + j);
            to->multipliers[j] = here - dot(w->effect, to->change, size);
            to->own[j] = here - dot(w->effect, to->limited, size);
            to->explained[j] = 0.0;
            for (Index a = 0; a < size; a++)
                to->explained[j] += w->effect[a] * dot(to->inverse + a * size, w->effect, size);
        }
        if (k == 0) break;
        for (Index i = 0; i < of->robots; i++) attributed(of, walk, i, k - 1, w, to);
        for (Index a = 3 * of->robots; a < s; a++) {
            w->told[a] *= of->decay;
            scale(w->by_unknowns + a * size, of->decay, size);
            scale(w->weight + a * s, of->decay, s);
            for (Index e = 0; e < s; e++) w->weight[e * s + a] *= of->decay;
        }
    }
}

static void slow_errors(const Measured *of, Work *w, Step *to)
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

static void ends_of(const Measured *of, Work *w, Step *to)
{
    const Index n3 = 3 * of->robots, s = states(of), q = unknowns(of), size = estimated(of);
    double *spread = w->vector, *effect = w->other;
    for (Index a = 0; a < n3; a++) {
        memcpy(to->ends + a * n3, w->p + a * s, sizeof(double) * n3);
        memset(spread, 0, sizeof(double) * size);
        for (Index e = 0; e < size; e++) add(spread, w->u[a * q + e], to->inverse + e * size, size);
        for (Index e = 0; e < n3; e++) to->ends[a * n3 + e] += dot(spread, w->u + e * q, size);
    }
    for (Index c = size; c < q; c++) {
        solved(w->lower, size, w->information + c * q, spread);
        for (Index a = 0; a < n3; a++) effect[a] = w->u[a * q + c] - dot(w->u + a * q, spread, size);
        for (Index a = 0; a < n3; a++) add(to->ends + a * n3, effect[a], effect, n3);
    }
}

/* Returns 0 if the information of the unknowns is not positive definite. */
int step(const Measured *of, const Walk *walk, const double *poses, const double *variance, double ridge,
         double largest, Work *w, Step *to)
{
    const Index n3 = 3 * of->robots, q = unknowns(of), size = estimated(of);
    if (!forward(of, walk, poses, variance, 1, w)) return 0;
    for (Index a = 0; a < n3; a++) {
        double *own = w->information + a * q + a;
        *own += ridge + ridge * *own;
    }
    if (!cholesky(w->information, q, 0, size, w->lower)) return 0;
    solved(w->lower, size, w->gradient, to->change);
    inverted(w->lower, size, w->vector, w->other, to->inverse);
    if (!cholesky(to->inverse, size, 0, n3, w->inner)) return 0;
    substituted(w->inner, n3, to->change, w->vector);
    const double length = sqrt(dot(w->vector, w->vector, n3));
    if (!limited(of, largest, to->change, w, to->limited)) return 0;
    backward(of, walk, w, to);
    double volume = 0.0;
    for (Index j = 0; j < of->ranges; j++) volume += log(w->variance[j]);
    for (Index a = 0; a < size; a++) volume += 2.0 * log(w->lower[a * size + a]);
    slow_errors(of, w, to);
    ends_of(of, w, to);
    to->numbers[0] = chi2_of(of, poses, to->change, w);
    to->numbers[1] = length;
    to->numbers[2] = volume;
    return 1;
}
