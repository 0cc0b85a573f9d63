/* `track` of odometry_noise.py, the initial guesses of anchor_guesses.py and placement_guesses.py, the likelihood of
   detections of evidence.py, `same` of posterior.py, `to_second_order` of planning_hypotheses.py, and the costs of
   active_sensing.py. These explain them, and have the constants.

   Sums over ranges are those of numpy (`summed`), so that the results are the same to the bit. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef long long Index;

/* What a function returns that got no memory. */
enum { NO_MEMORY = -2 };

/* A function that is compiled for each number of unknowns. */
#define SIZED static inline __attribute__((always_inline))

int solutions(Index count, Index size, Index columns, double *matrix, double *right);
void products(Index count, Index p, Index q, Index r, const double *left, Index left_step, const double *right,
              Index right_step, double *to);
void eigen(Index size, double *matrix, double *vectors);

#define SIGMA_FLOOR 1e-6
#define LARGEST_RATIO 700.0
#define LEAST_CHANGE 1e-12
#define SLIGHT 1e-4
#define CONSTANT_ERRORS 3
#define TAU (2.0 * M_PI)

/* The densities of ranges (see range_model.py): logarithms of the shares of inliers, outliers and strays with
   those of their densities, minus infinity without any; the least and the largest bias of outliers. */
typedef struct {
    double inlier, outlier, stray, least, most;
} Mixture;

/* The sigma (m) of each range, and the logarithms in its densities. */
typedef struct {
    Index count;
    const Mixture *by;
    double *sigma, *log_sigma, *log_width;
} Spread;

static double larger(double one, double other) { return other > one || isnan(other) ? other : one; }

static double length(double x, double y) { return sqrt(x * x + y * y); }

static double remainder_of(double x, double by)
{
    const double left = fmod(x, by);
    return left < 0.0 ? left + by : left + 0.0;
}

static double log_sum(double one, double other)
{
    const double most = one > other ? one : other, apart = fabs(one - other);
    if (apart > 40.0 && fabs(most) > 0.1) return most; /* as the sum would be rounded */
    return one == other ? most + M_LN2 : most + log1p(exp(-apart));
}

/* The sum in the order of numpy: pairwise, with eight partial sums. */
static double summed(const double *values, Index count)
{
    double total = 0.0, part[8];
    if (count > 128) {
        const Index half = count / 2 - count / 2 % 8;
        return summed(values, half) + summed(values + half, count - half);
    }
    if (count < 8) {
        for (Index j = 0; j < count; j++) total += values[j];
        return total;
    }
    Index j = 8;
    memcpy(part, values, sizeof part);
    for (; j < count - count % 8; j += 8)
        for (int p = 0; p < 8; p++) part[p] += values[j + p];
    total = ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]));
    for (; j < count; j++) total += values[j];
    return total;
}

/* --- paths ---------------------------------------------------------------------------------------------- */

#define NO_TURN 1e-20

/* Set the x and y, the headings and the displacements per unit of v of `paths`; `slip` may be NULL. */
void tracked(Index paths, Index ticks, double period, const double *v, const double *omega, const double *slip,
             double *place, double *heading, double *shift)
{
    for (Index path = 0; path < paths; path++, v += ticks, omega += ticks, shift += 2 * ticks) {
        double *x = place + 2 * path * (ticks + 1), *y = x + ticks + 1;
        x[0] = y[0] = heading[0] = 0.0;
        for (Index k = 0; k < ticks; k++) {
            const double half = (0.5 * period) * omega[k], turn = half == 0.0 ? NO_TURN : half;
            const double course = slip ? heading[k] + half + *slip++ : heading[k] + half;
            const double unit = period * (sin(turn) / turn);
            shift[k] = unit * cos(course);
            shift[ticks + k] = unit * sin(course);
            heading[k + 1] = heading[k] + period * omega[k];
            x[k + 1] = x[k] + v[k] * shift[k];
            y[k + 1] = y[k] + v[k] * shift[ticks + k];
        }
        heading += ticks + 1;
    }
}

/* How the relative length of a chord changes with omega, in s, by half of the angle that it turns by. */
static double shortening(double half, double period)
{
    const double by_half = fabs(half) < SLIGHT ? half / -3.0 : 1.0 / tan(half) - 1.0 / half;
    return (0.5 * period) * by_half;
}

/* See odometry_noise.position_variances; there are `count` patterns, at most CONSTANT_ERRORS. */
void position_variances(Index ticks, double period, const double *v, const double *omega, const double *place,
                        const double *shift, const double *white, Index count, const double *patterns, double *to)
{
    static const int of[5][2] = {{0, 0}, {1, 1}, {1, 2}, {0, 2}, {2, 2}};
    const double *x = place, *y = place + ticks + 1;
    double by_white[5] = {0.0}, constant[CONSTANT_ERRORS][3] = {{0.0}};
    to[0] = 0.0;
    for (Index k = 0; k < ticks; k++) {
        const double longer = v[k] * shortening((0.5 * period) * omega[k], period);
        const double middle[2] = {0.5 * (x[k] + x[k + 1]), 0.5 * (y[k] + y[k + 1])};
        const double effects[3][2] = {{shift[k], longer * shift[k] + period * middle[1]},
                                      {shift[ticks + k], longer * shift[ticks + k] - period * middle[0]},
                                      {0.0, period}};
        double rigid[5];
        for (int p = 0; p < count; p++)
            for (int a = 0; a < 3; a++) {
                const double *pattern = patterns + 2 * p * ticks + k;
                constant[p][a] += effects[a][0] * pattern[0] + effects[a][1] * pattern[ticks];
            }
        for (int t = 0; t < 5; t++) {
            const double *one = effects[of[t][0]], *other = effects[of[t][1]];
            by_white[t] += one[0] * other[0] * white[k] + one[1] * other[1] * white[ticks + k];
            rigid[t] = by_white[t];
            for (int p = 0; p < count; p++) rigid[t] += constant[p][of[t][0]] * constant[p][of[t][1]];
        }
        const double at_x = x[k + 1], at_y = y[k + 1];
        double found = rigid[0] + rigid[1] + 2.0 * (at_x * rigid[2] - at_y * rigid[3]);
        found += (at_x * at_x + at_y * at_y) * rigid[4];
        to[k + 1] = found < 0.0 ? 0.0 : found;
    }
}

/* --- the densities of ranges ------------------------------------------------------------------------- */

/* Set the sigmas that include an error of `more` m of the guesses. */
static void widen(Spread *to, const double *sigma, double more)
{
    for (Index j = 0; j < to->count; j++) {
        to->sigma[j] = length(sigma[j], more);
        to->log_sigma[j] = log(to->sigma[j]);
        to->log_width[j] = log(larger(to->by->most - to->by->least, to->sigma[j]));
    }
}

static double inlier_density(double residual, const Spread *of, Index j)
{
    const double in_sigmas = residual / of->sigma[j];
    return -0.5 * (in_sigmas * in_sigmas) - of->log_sigma[j] + of->by->inlier;
}

static double outlier_density(double residual, const Spread *of, Index j)
{
    const Mixture *by = of->by;
    const double stray = by->stray - of->log_sigma[j];
    if (by->outlier == -INFINITY) return stray;
    const double beyond = larger(larger(by->least - residual, residual - by->most), 0.0) / of->sigma[j];
    const double density = -of->log_width[j] - 0.5 * (beyond * beyond) + by->outlier;
    return by->stray == -INFINITY ? density : log_sum(density, stray);
}

static int robust(const Mixture *by) { return by->outlier > -INFINITY || by->stray > -INFINITY; }

/* range_model.inlier_probability over the variance */
static double weight_of(double residual, const Spread *of, Index j)
{
    const double variance = of->sigma[j] * of->sigma[j];
    if (!robust(of->by)) return 1.0 / variance;
    const double ratio = outlier_density(residual, of, j) - inlier_density(residual, of, j);
    return 1.0 / (1.0 + exp(ratio > LARGEST_RATIO ? LARGEST_RATIO : ratio)) / variance;
}

/* range_model.log_likelihood of the residuals, which are overwritten */
static double log_likelihood(double *residuals, const Spread *of)
{
    for (Index j = 0; j < of->count; j++) {
        const double good = inlier_density(residuals[j], of, j);
        residuals[j] = robust(of->by) ? log_sum(good, outlier_density(residuals[j], of, j)) : good;
    }
    return summed(residuals, of->count);
}

/* --- an anchor in the frame of the odometry ----------------------------------------------------------- */

/* The ranges to the anchor, and from where. */
typedef struct {
    Index count;
    const double *x, *y, *rho, *sigma;
} Circles;

/* Append the intersections of each two of the circles to `points`; returns the number of all. */
static Index crossings(const Circles *of, Index couples, const Index *first, const Index *second, Index known,
                       double *points)
{
    Index count = known;
    for (int way = 1; way >= -1; way -= 2)
        for (Index n = 0; n < couples; n++) {
            const Index i = first[n], j = second[n];
            const double dx = of->x[j] - of->x[i], dy = of->y[j] - of->y[i], apart = length(dx, dy);
            if (!(apart > SIGMA_FLOOR)) continue;
            const double rho = of->rho[i] * of->rho[i];
            const double along = (apart * apart + rho - of->rho[j] * of->rho[j]) / (2.0 * apart);
            const double across = way * sqrt(larger(rho - along * along, 0.0));
            points[2 * count] = of->x[i] + (along * dx - across * dy) / apart;
            points[2 * count++ + 1] = of->y[i] + (along * dy + across * dx) / apart;
        }
    return count;
}

/* The step of Gauss-Newton on a point; `work` has five values for each range. */
static void polish(const Circles *of, const Spread *spread, double most, double *point, double *work)
{
    const Index count = of->count;
    double *ux = work, *uy = work + count, *weight = work + 2 * count, *terms = work + 3 * count, sums[5];
    double *residual = work + 4 * count;
    for (Index j = 0; j < count; j++) {
        const double dx = of->x[j] - point[0], dy = of->y[j] - point[1];
        const double distance = larger(length(dx, dy), SIGMA_FLOOR);
        residual[j] = of->rho[j] - distance;
        ux[j] = dx / distance;
        uy[j] = dy / distance;
        weight[j] = weight_of(residual[j], spread, j);
    }
    for (int t = 0; t < 5; t++) {
        const double *left = t == 2 || t == 4 ? uy : ux, *right = t == 0 ? ux : t < 3 ? uy : residual;
        for (Index j = 0; j < count; j++) terms[j] = weight[j] * left[j] * right[j];
        sums[t] = summed(terms, count);
    }
    const double damping = 1e-6 * (sums[0] + sums[2]) + 1e-12, gx = -sums[3], gy = -sums[4], xy = sums[1];
    const double xx = sums[0] + damping, yy = sums[2] + damping, determinant = xx * yy - xy * xy;
    const double x = (yy * gx - xy * gy) / determinant, y = (xx * gy - xy * gx) / determinant;
    const double shorter = most / larger(larger(fabs(x), fabs(y)), LEAST_CHANGE);
    point[0] += x * (shorter < 1.0 ? shorter : 1.0);
    point[1] += y * (shorter < 1.0 ? shorter : 1.0);
}

/* Set `points` to the likeliest anchors, of which the first `known` are given; returns their number, at most
   `most`, or -2 without memory. `finer` are the errors (m) that are expected of them before each of the `steps`,
   and at the end. */
Index anchor_guesses(Index count, const double *x, const double *y, const double *rho, const double *sigma,
                     const Mixture *by, Index couples, const Index *first, const Index *second, Index known,
                     Index steps, const double *finer, double longest, double unlikely, double near, Index most,
                     double *points)
{
    const Circles of = {count, x, y, rho, sigma};
    const Index all = crossings(&of, couples, first, second, known, points);
    double *work = malloc(sizeof(double) * (8 * count + 3 * all)), *likely = work + 8 * count, best = -INFINITY;
    if (!work) return NO_MEMORY;
    double *kept = likely + all;
    Spread spread = {count, by, work + 5 * count, work + 6 * count, work + 7 * count};
    for (Index step = 0; step < steps; step++) {
        widen(&spread, sigma, finer[step]);
        for (Index n = 0; n < all; n++) polish(&of, &spread, longest, points + 2 * n, work);
    }
    widen(&spread, sigma, finer[steps]);
    for (Index n = 0; n < all; n++) {
        for (Index j = 0; j < count; j++)
            work[j] = rho[j] - larger(length(x[j] - points[2 * n], y[j] - points[2 * n + 1]), SIGMA_FLOOR);
        best = larger(best, likely[n] = log_likelihood(work, &spread));
    }
    Index chosen = 0;
    for (; chosen < most; chosen++) {
        Index next = -1;
        for (Index n = 0; n < all; n++)
            if (likely[n] >= best - unlikely && (next < 0 || likely[n] > likely[next])) next = n;
        if (next < 0) break;
        const double *at = memcpy(kept + 2 * chosen, points + 2 * next, 2 * sizeof(double));
        for (Index n = 0; n < all; n++)
            if (!(fabs(points[2 * n] - at[0]) + fabs(points[2 * n + 1] - at[1]) > near)) likely[n] = NAN;
    }
    memcpy(points, kept, sizeof(double) * 2 * chosen);
    free(work);
    return chosen;
}

/* --- the placement of a pair --------------------------------------------------------------------------- */

#define UNKNOWNS 8 /* the rotations of the near and of the far robot, and the whitened offset of each */

/* placement_guesses.Encounter: the places at the ranges, and the root of the covariance of the offset. */
typedef struct {
    const double *x, *y, *root;
} Encounter;

/* The mutual ranges (m) between the near and the far robot; `apart` are x and y (m) between their anchors, and
   `lever` are the distances (m) to these. */
typedef struct {
    Index count, middle;
    Encounter robots[2];
    const double *rho, *apart, *lever;
} Meeting;

/* A guess with what follows from it. */
typedef struct {
    double z[UNKNOWNS], likely, gap[2];
    Index number;
} Placed;

/* Set the vector (m) between the robots at the middle range, and the residuals (m) of `z` with their derivatives
   by its first `unknowns`: 0, 2 (rotations) or 8. */
SIZED void residuals_at(
    const Meeting *of, Index unknowns, const double *z, double *gap, double *residuals, double *jacobian)
{
    double x[2], y[2], c[2], s[2], offset[2][3] = {{0.0}};
    for (int i = 0; i < 2; i++) {
        const double *own = z + 2 + 3 * i, *root = of->robots[i].root;
        c[i] = cos(z[i]);
        s[i] = sin(z[i]);
        for (int b = 0; b < 3; b++)
            for (int a = 0; a < 3; a++) offset[i][a] += own[b] * root[3 * a + b];
    }
    for (Index j = 0; j < of->count; j++) {
        double qx[2], qy[2];
        for (int i = 0; i < 2; i++) {
            const Encounter *robot = of->robots + i;
            qx[i] = robot->x[j] - robot->x[of->middle];
            qy[i] = robot->y[j] - robot->y[of->middle];
            const double at_x = robot->x[j] + offset[i][0] - offset[i][2] * qy[i];
            const double at_y = robot->y[j] + offset[i][1] + offset[i][2] * qx[i];
            x[i] = c[i] * at_x - s[i] * at_y;
            y[i] = s[i] * at_x + c[i] * at_y;
        }
        const double dx = x[1] - x[0] - of->apart[0], dy = y[1] - y[0] - of->apart[1];
        const double distance = larger(length(dx, dy), SIGMA_FLOOR), ux = dx / distance, uy = dy / distance;
        residuals[j] = of->rho[j] - distance;
        if (j == of->middle) gap[0] = dx, gap[1] = dy;
        if (!unknowns) continue;
        double *row = memset(jacobian + UNKNOWNS * j, 0, sizeof(double) * UNKNOWNS);
        row[0] = ux * y[0] - uy * x[0];
        row[1] = uy * x[1] - ux * y[1];
        for (int i = 0; i < 2 && unknowns > 2; i++) {
            const double sign = i ? 1.0 : -1.0, *root = of->robots[i].root;
            const double along = sign * (c[i] * ux + s[i] * uy), across = sign * (c[i] * uy - s[i] * ux);
            const double by[3] = {along, across, across * qx[i] - along * qy[i]};
            for (int b = 0; b < 3; b++)
                for (int a = 0; a < 3; a++) row[2 + 3 * i + a] += by[b] * root[3 * b + a];
        }
    }
}

/* The log-likelihood of `z`; `gap` is the vector (m) between the robots. */
static double likelihood_of(const Meeting *of, const Spread *spread, const double *z, double *gap, double *work)
{
    double squares[UNKNOWNS - 2];
    for (int a = 2; a < UNKNOWNS; a++) squares[a - 2] = z[a] * z[a];
    residuals_at(of, 0, z, gap, work, NULL);
    return log_likelihood(work, spread) - 0.5 * summed(squares, UNKNOWNS - 2);
}

/* Move `z` by a step of Gauss-Newton on its first `unknowns`. Returns 0 if a matrix is singular. */
SIZED int turn(const Meeting *of, const Spread *spread, Index unknowns, double damping, double most, double *z,
                double *work)
{
    double *residuals = work, *jacobian = work + of->count, gap[2];
    double information[UNKNOWNS * UNKNOWNS] = {0.0}, change[UNKNOWNS] = {0.0};
    residuals_at(of, unknowns, z, gap, residuals, jacobian);
    for (Index j = 0; j < of->count; j++) {
        const double weight = weight_of(residuals[j], spread, j), *row = jacobian + UNKNOWNS * j;
        for (Index a = 0; a < unknowns; a++) {
            const double factor = row[a] * weight;
            for (Index b = 0; b < unknowns; b++) information[a * unknowns + b] += factor * row[b];
            change[a] += factor * residuals[j];
        }
    }
    damping = damping * (information[0] + information[unknowns + 1]) + 1e-12;
    for (Index a = 0; a < unknowns; a++) {
        information[a * unknowns + a] += a < 2 ? damping : 1.0;
        if (a >= 2) change[a] -= z[a];
    }
    if (!solutions(1, unknowns, 1, information, change)) return 0;
    const double shorter = most / larger(larger(fabs(change[0]), fabs(change[1])), LEAST_CHANGE);
    for (Index a = 0; a < unknowns; a++) z[a] += change[a] * (shorter < 1.0 ? shorter : 1.0);
    return 1;
}

/* The likeliest first, the others at the end */
static int by_likelihood(const void *one, const void *other)
{
    const Placed *a = one, *b = other;
    const int unordered = isnan(a->likely) - isnan(b->likely);
    if (unordered) return unordered;
    if (a->likely != b->likely && !isnan(a->likely)) return a->likely > b->likely ? -1 : 1;
    return a->number < b->number ? -1 : 1;
}

/* Set the likelihoods and sort by them; returns the number of those that are not `unlikely`. */
static Index sorted(const Meeting *of, const Spread *spread, double unlikely, Index count, Placed *all, double *work)
{
    for (Index n = 0; n < count; n++) {
        all[n].likely = likelihood_of(of, spread, all[n].z, all[n].gap, work);
        all[n].number = n;
    }
    qsort(all, count, sizeof *all, by_likelihood);
    Index left = 0;
    while (left < count && all[left].likely >= all[0].likely - unlikely) left++;
    return left;
}

/* Keep the likeliest in each of the cells of `near` m, at most `crowd`; returns their number. */
static Index thinned(const Meeting *of, double near, Index crowd, Index count, Placed *all, Index (*cells)[4])
{
    Index kept = 0;
    for (Index n = 0; n < count && kept < crowd; n++) {
        Index *cell = cells[kept], k = 0;
        for (int a = 0; a < 2; a++) {
            cell[a] = (Index)rint(remainder_of(all[n].z[a], TAU) * of->lever[a] / near);
            cell[2 + a] = (Index)rint(all[n].gap[a] / near);
        }
        while (k < kept && memcmp(cells[k], cell, sizeof *cells)) k++;
        if (k == kept) all[kept++] = all[n];
    }
    return kept;
}

/* Keep the likeliest at different placements, at most `most`, unless the likelihood falls by `ridge` between
   them; returns their number. */
static Index distinct(const Meeting *of, const Spread *spread, double near, double ridge, Index most, Index count,
                      Placed *all, double *work)
{
    Index kept = 0;
    for (; count > kept && kept < most; kept++) {
        const Placed *best = all + kept;
        Index left = kept + 1;
        for (Index n = left; n < count; n++) {
            double way[UNKNOWNS], between[UNKNOWNS], gap[2], distance = 0.0;
            for (int a = 0; a < UNKNOWNS; a++) {
                way[a] = all[n].z[a] - best->z[a];
                if (a < 2) way[a] = remainder_of(way[a] + M_PI, TAU) - M_PI;
                between[a] = best->z[a] + 0.5 * way[a];
            }
            distance = fabs(way[0]) * of->lever[0] + fabs(way[1]) * of->lever[1];
            distance += fabs(all[n].gap[0] - best->gap[0]) + fabs(all[n].gap[1] - best->gap[1]);
            if (distance > near || likelihood_of(of, spread, between, gap, work) < all[n].likely - ridge)
                all[left++] = all[n];
        }
        count = left;
    }
    return kept;
}

/* The far robot's circle about its anchor at the mutual range `at`: its radius (m), its square, the whitened
   offset that leads to it, the square of the range, and the number of rotations that are tried. */
typedef struct {
    double at, rotations, radius, squared, offset[3], rho_squared;
} Circle;

/* Set `to` to the guesses of a circle, two for each of the rotations; returns their end. */
static Placed *scanned(const Meeting *of, const Circle *circle, Placed *to)
{
    const Index j = (Index)circle->at;
    const Encounter *near = of->robots, *far = of->robots + 1;
    const double ahead = atan2(far->y[j], far->x[j]);
    for (int way = 1; way >= -1; way -= 2)
        for (Index t = 0; t < (Index)circle->rotations; t++, to++) {
            const double turn = t * (TAU / circle->rotations) - M_PI, c = cos(turn), s = sin(turn);
            const double x = of->apart[0] + c * near->x[j] - s * near->y[j];
            const double y = of->apart[1] + s * near->x[j] + c * near->y[j];
            const double gap = larger(length(x, y), SIGMA_FLOOR);
            const double cosine = (gap * gap + circle->squared - circle->rho_squared) / (2.0 * gap * circle->radius);
            memset(to->z, 0, sizeof to->z);
            to->z[0] = turn;
            to->z[1] = atan2(y, x) - ahead + way * acos(cosine < -1.0 ? -1.0 : cosine > 1.0 ? 1.0 : cosine);
            memcpy(to->z + 5, circle->offset, sizeof circle->offset);
        }
    return to;
}

/* Set `found` to the likeliest placements by the `guesses` of all `circles`, with their log-likelihoods as a last
   column; returns their number, at most `most`, or -1 if a matrix is singular, or -2 without memory. `finer` are the
   errors (m) of the guesses before each of the `steps`, and at the end, and `damping` those of the rotations. */
Index placements(Index count, Index middle, const double *near_x, const double *near_y, const double *near_root,
                 const double *far_x, const double *far_y, const double *far_root, const double *rho,
                 const double *sigma, const Mixture *by, const double *apart, const double *lever, Index circles,
                 const Circle *circle, Index guesses, Index steps, const double *finer, const double *damping,
                 double largest, double cell, Index crowd, double unlikely, double near, double ridge, Index most,
                 double *found)
{
    const Meeting of = {count, middle, {{near_x, near_y, near_root}, {far_x, far_y, far_root}}, rho, apart, lever};
    Placed *all = malloc(sizeof *all * guesses), *end = all;
    double *work = malloc(sizeof(double) * count * (UNKNOWNS + 4)), *logs = work + count * (UNKNOWNS + 1);
    Index (*cells)[4] = malloc(sizeof *cells * crowd);
    Spread spread = {count, by, logs, logs + count, logs + 2 * count};
    if (!all || !work || !cells) circles = 0, steps = NO_MEMORY;
    for (Index k = 0; k < circles; k++) end = scanned(&of, circle + k, end);
    Index left = end - all;
    for (Index step = 0; step < steps; step++) {
        const int crowded = left > crowd; /* of many guesses, only the rotations */
        widen(&spread, sigma, finer[step]);
        for (Index n = 0; n < left; n++)
            if (!(crowded ? turn(&of, &spread, 2, damping[step], largest, all[n].z, work)
                          : turn(&of, &spread, UNKNOWNS, damping[step], largest, all[n].z, work)))
                steps = -1, left = 0;
        if (left <= crowd) continue;
        widen(&spread, sigma, finer[step + 1]);
        left = thinned(&of, cell, crowd, sorted(&of, &spread, unlikely, left, all, work), all, cells);
    }
    if (steps > 0) {
        widen(&spread, sigma, finer[steps]);
        left = sorted(&of, &spread, unlikely, left, all, work);
        left = distinct(&of, &spread, near, ridge, most, left, all, work);
        for (Index n = 0; n < left; n++) memcpy(found + n * (UNKNOWNS + 1), all[n].z, sizeof(double) * (UNKNOWNS + 1));
    }
    free(all);
    free(work);
    free(cells);
    return steps > 0 ? left : steps;
}

/* --- detections, and ticks without one ------------------------------------------------------------------ */

/* What the likelihood of detections depends on, besides a fit and the ticks. */
typedef struct {
    double reach, clear, edge, drop_outs, silent;
} Detection;

static double log_cdf(double x)
{
    if (x > -30.0) return log(0.5 * erfc(-x / sqrt(2.0)));
    return -0.5 * x * x - log(-x * sqrt(2.0 * M_PI));
}

static int by_size(const void *one, const void *other)
{
    const double a = *(const double *)one, b = *(const double *)other;
    return (a > b) - (a < b);
}

/* The log-likelihood of no detection at ticks at which the distance is `beyond` (m) R, which are sorted. */
double no_detection(Index count, double *beyond, double sigma, double drop_outs, Index most)
{
    double likelihood = 0.0, below = 0.0;
    if (!count) return 0.0;
    qsort(beyond, count, sizeof *beyond, by_size);
    sigma = larger(sigma, SIGMA_FLOOR);
    if (drop_outs == 0.0) return log_cdf(beyond[0] / sigma);
    for (Index n = 0; n <= (count < most ? count : most); n++) {
        const int last = n == count || n == most;
        const double up_to = last ? 1.0 : 0.5 * erfc(-(beyond[n] / sigma) / sqrt(2.0));
        likelihood += pow(drop_outs, (double)n) * (up_to - below);
        below = up_to;
    }
    return log(larger(likelihood, 1e-300));
}

/* The log-likelihood of a detection (`sign` -1) or of none (1) at each of the ticks, between the robot `first` and
   the robot `second`, or the anchor at its pivot if that is -1, with memory from `beyond` on; for the others, see
   `detections`. */
static double seen(const Detection *by, Index first, Index second, double sign, Index count, const Index *ticks,
                   Index robots, Index points, const double *paths, const double *poses, const double *pivot,
                   double level, const double *inverse, Index width, double *beyond)
{
    const Index size = second < 0 ? 2 : 3 * robots, begin = second < 0 ? 3 * first : 0;
    double *gradient = beyond + count, *terms = gradient + size;
    double dx = 0.0, dy = 0.0, nearest = INFINITY, weight = 0.0;
    Index worst = -1;
    for (Index k = 0; k < count; k++) {
        const double *at = paths + 3 * (first * points + ticks[k]), *other = pivot + 2 * first;
        if (second >= 0) other = paths + 3 * (second * points + ticks[k]);
        const double x = at[0] - other[0], y = at[1] - other[1], distance = length(x, y);
        beyond[k] = sign * (distance - by->reach);
        const double near = second < 0 ? beyond[k] : distance;
        if (near < nearest) nearest = near, worst = k, dx = x, dy = y;
    }
    if (worst >= 0 && !(beyond[worst] > by->clear * by->reach)) {
        const double distance = larger(length(dx, dy), SIGMA_FLOOR), nx = dx / distance, ny = dy / distance;
        const double least = beyond[worst];
        memset(gradient, 0, sizeof *gradient * size);
        for (int end = 0; end < (second < 0 ? 1 : 2); end++) {
            const Index i = end ? second : first;
            const double *at = paths + 3 * (i * points + ticks[worst]), way = end ? -1.0 : 1.0;
            const double c = cos(poses[3 * i + 2]), s = sin(poses[3 * i + 2]);
            double *own = gradient + 3 * i - begin;
            own[0] = second < 0 ? (c * dx + s * dy) / distance : -way * (c * nx + s * ny);
            own[1] = second < 0 ? (c * dy - s * dx) / distance : -way * (c * ny - s * nx);
            if (second >= 0) own[2] = way * (ny * (at[0] - pivot[2 * i]) - nx * (at[1] - pivot[2 * i + 1]));
        }
        for (Index a = 0; a < size; a++) {
            double row = 0.0;
            for (Index b = 0; b < size; b++) row += level * inverse[(begin + a) * width + begin + b] * gradient[b];
            terms[a] = gradient[a] * row;
        }
        const double variance = summed(terms, size), sigma = variance >= 0.0 ? sqrt(variance) : INFINITY;
        const double spread = length(sigma, by->edge * by->reach);
        weight = sign < 0.0 ? log_cdf(least / spread) : no_detection(count, beyond, spread, by->drop_outs, (Index)by->silent);
    }
    return weight;
}

/* Set `total` to the log-likelihood of all `terms`; returns -2 without memory. Each is a first robot, a second one or
   -1, the sign, and the number of its ticks. Those of a fit: `paths` have `points` poses each, `poses` are those at tick 0, and `level` times `inverse` is their
   covariance, with rows of `width` elements. */
int detections(const Detection *by, Index count, const Index *terms, const Index *ticks, Index robots, Index points,
               const double *paths, const double *poses, const double *pivot, double level, const double *inverse,
               Index width, double *total)
{
    Index most = 0;
    for (Index t = 0; t < count; t++) most = terms[4 * t + 3] > most ? terms[4 * t + 3] : most;
    double *memory = malloc(sizeof *memory * (most + 6 * robots)), between = 0.0;
    if (!memory) return NO_MEMORY;
    *total = 0.0;
    for (Index t = 0; t < count; t++, ticks += terms[3], terms += 4) {
        between += seen(by, terms[0], terms[1], (double)terms[2], terms[3], ticks, robots, points, paths, poses, pivot,
                        level, inverse, width, memory);
        if (t + 1 < count && terms[4] == terms[0] && terms[5] == terms[1]) continue;
        *total += between;
        between = 0.0;
    }
    free(memory);
    return 0;
}

/* --- the same poses -------------------------------------------------------------------------------------- */

/* Set for each robot whether two poses differ by less than `most` squared sigmas of the second, also along each
   axis; directions whose variance is at most `none` times the largest one do not count. */
void same_poses(Index robots, const double *one, const double *other, const double *covariance, double most,
                double none, Index *found)
{
    for (Index i = 0; i < 3 * robots; i += 3) {
        double block[9], axes[9], change[3], largest = 0.0, squared = 0.0;
        Index far = 0;
        for (int a = 0; a < 3; a++) {
            memcpy(block + 3 * a, covariance + (i + a) * 3 * robots + i, 3 * sizeof *block);
            change[a] = one[i + a] - other[i + a];
            if (a == 2) change[a] = remainder_of(change[a] + M_PI, TAU) - M_PI;
            far |= block[4 * a] > 0.0 && change[a] * change[a] > most * block[4 * a];
        }
        found[i / 3] = 0;
        if (far) continue;
        eigen(3, block, axes);
        for (int a = 0; a < 3; a++) largest = larger(largest, fabs(block[4 * a]));
        for (int a = 0; a < 3; a++) {
            const double along = change[0] * axes[a] + change[1] * axes[3 + a] + change[2] * axes[6 + a];
            if (block[4 * a] > none * largest) squared += along * along / block[4 * a];
        }
        found[i / 3] = squared < most;
    }
}

/* --- poses to second order ----------------------------------------------------------------------------------- */

/* Add the terms of second order in ranges and bearings to the mean and the covariance of the poses of a and b. `seen` has
   the x, the y, the range (m) and its square, of b from M2 and then of a from b. */
void second_order(const double *seen, double *mean, double *covariance)
{
    double rows[24] = {0.0}, columns[24], by_rows[24], polar[16], second[96] = {0.0}, curved[96], turned[96], more[36];
    for (Index k = 0; k < 4; k += 2, seen += 4) {
        const double x = seen[0], y = seen[1], rho = seen[2], squared = seen[3];
        const double by[2][2] = {{x / rho, y / rho}, {-y / squared, x / squared}};
        for (Index row = k; row < k + 2; row++)
            for (Index a = 0; a < 2; a++) {
                rows[6 * row + (k ? 0 : 3) + a] = by[row - k][a];
                if (k) rows[6 * row + 3 + a] = -by[row - k][a];
            }
        for (Index i = 0; i <= (k ? 0 : 3); i += 3) {
            double *of_x = second + 16 * i, *of_y = of_x + 16;
            of_x[5 * (k + 1)] = -x;
            of_y[5 * (k + 1)] = -y;
            of_x[4 * k + k + 1] = of_x[4 * (k + 1) + k] = -y / rho;
            of_y[4 * k + k + 1] = of_y[4 * (k + 1) + k] = x / rho;
        }
    }
    for (Index e = 0; e < 24; e++) columns[e % 6 * 4 + e / 6] = rows[e];
    products(1, 4, 6, 6, rows, 0, covariance, 0, by_rows);
    products(1, 4, 6, 4, by_rows, 0, columns, 0, polar);
    double scale[4] = {1.0, 1.0, 1.0, 1.0};
    for (Index k = 1; k < 4; k += 2) { /* the expansion holds for small angles only */
        const double least = 1.0 / sqrt(polar[5 * k] < 1e-300 ? 1e-300 : polar[5 * k]);
        scale[k] = least < 1.0 ? least : 1.0;
    }
    for (Index e = 0; e < 16; e++) polar[e] = polar[e] * scale[e / 4] * scale[e % 4];
    products(6, 4, 4, 4, second, 16, polar, 0, curved);
    for (Index a = 0; a < 6; a++) {
        const double *own = curved + 16 * a;
        mean[a] += 0.5 * (own[0] + own[5] + own[10] + own[15]);
        for (Index e = 0; e < 16; e++) turned[6 * (e % 4 * 4 + e / 4) + a] = own[e];
    }
    products(1, 6, 16, 6, curved, 0, turned, 0, more);
    for (Index e = 0; e < 36; e++) covariance[e] = covariance[e] + 0.5 * more[e];
}

/* --- the costs of manoeuvres ------------------------------------------------------------------------------- */

/* What costs depend on, besides the hypotheses: lengths (m), the sigma of mutual ranges (m), the sigma and the variance of
   ranges to anchors, the squared accuracy, and costs per m; `confused` and `standing` are costs. */
typedef struct {
    double reach, sigma, anchor_sigma, anchor_variance, squared_accuracy, far_predicted, gap_sigma, largest_gap, confused;
    double farthest, nearest, nearest_to_anchor, outside, near, standing;
} Weighed;

/* The positions (m) after each of the strides from `pose`. */
static void ends_of(const double *pose, Index strides, const double *along, const double *across, double *x, double *y)
{
    const double c = cos(pose[2]), s = sin(pose[2]);
    for (Index t = 0; t < strides; t++) {
        x[t] = pose[0] + c * along[t] - s * across[t];
        y[t] = pose[1] + s * along[t] + c * across[t];
    }
}

/* The expected cost of confusing the first hypothesis with another, by the predicted distances (m) of each. */
static double confusion(const Weighed *by, Index hypotheses, const double *probability, Index strides,
                        const double *distance)
{
    double remaining = 0.0, gaps[strides];
    for (Index h = 1; h < hypotheses; h++) {
        for (Index t = 0; t < strides; t++) {
            const double one = distance[h * strides + t], first = distance[t], most = by->far_predicted;
            const double gap = ((one < most ? one : most) - (first < most ? first : most)) / by->gap_sigma;
            gaps[t] = gap * gap;
        }
        const double gap = summed(gaps, strides);
        remaining += sqrt(probability[0] * probability[h]) * exp(-(gap < by->largest_gap ? gap : by->largest_gap) / 8.0);
    }
    return by->confused * remaining;
}

/* Set the costs of `count` manoeuvres of a robot about its anchor, the last of which is to stand. By each hypothesis, it
   has to stay nearer than `farthest` by one of `margins` (m); `information` is that on its position. */
void own_costs(const Weighed *by, Index count, Index strides, const double *along, const double *across,
               Index hypotheses, const double *probability, const double *poses, const double *margins,
               const double *information, double *cost)
{
    double x[strides], y[strides], distance[hypotheses * strides], terms[3][strides];
    for (Index n = 0; n < count; n++) {
        for (Index h = hypotheses - 1; h >= 0; h--) {
            ends_of(poses + 3 * h, strides, along + n * strides, across + n * strides, x, y);
            for (Index t = 0; t < strides; t++)
                distance[h * strides + t] = larger(length(x[t], y[t]), SIGMA_FLOOR);
        }
        for (Index t = 0; t < strides; t++) {
            const double ux = x[t] / distance[t], uy = y[t] / distance[t];
            const double weight = (distance[t] <= by->reach) / by->anchor_variance;
            terms[0][t] = weight * ux * ux;
            terms[1][t] = weight * ux * uy;
            terms[2][t] = weight * uy * uy;
        }
        const double xx = information[0] + summed(terms[0], strides), xy = information[1] + summed(terms[1], strides);
        const double yy = information[3] + summed(terms[2], strides);
        cost[n] = (xx + yy) / larger(xx * yy - xy * xy, 1e-300) / by->squared_accuracy;
        cost[n] += confusion(by, hypotheses, probability, strides, distance);
        if (n == count - 1) cost[n] += by->standing;
        for (Index h = 0; h < hypotheses; h++) {
            const double away = distance[h * strides];
            cost[n] += probability[h] * by->near * larger(0.0, by->nearest_to_anchor - away);
            cost[n] += probability[h] * by->outside * larger(0.0, away + margins[h] - by->farthest);
        }
    }
}

/* Add the cost of the variance of both positions after ranges of a and b, which drive to x and y (m); returns 0 if the
   information is singular. `anchors` are the places (m) of their anchors, and `distance` those (m) between them. */
static int add_variance(const Weighed *by, Index strides, const double *pose, const double *x, const double *y,
                       const double *distance, const double *anchors, const double *information, double *cost)
{
    double rows[3 * strides][6], after[36] = {0.0}, identity[36] = {0.0};
    memset(rows, 0, sizeof rows);
    for (Index t = 0; t < strides; t++) {
        const double nx = (x[t] - x[strides + t]) / distance[t], ny = (y[t] - y[strides + t]) / distance[t];
        const double weight = (distance[t] <= by->reach) / by->sigma;
        for (int i = 0; i < 2; i++) {
            const double sign = i ? -1.0 : 1.0, at_x = x[i * strides + t], at_y = y[i * strides + t];
            const double lx = at_x - pose[3 * i], ly = at_y - pose[3 * i + 1];
            const double ox = at_x - anchors[2 * i], oy = at_y - anchors[2 * i + 1];
            const double rho = larger(length(ox, oy), SIGMA_FLOOR);
            const double own = (rho <= by->reach) / rho / by->anchor_sigma;
            double *mutual = rows[t] + 3 * i, *to_anchor = rows[(i + 1) * strides + t] + 3 * i;
            mutual[0] = sign * nx * weight;
            mutual[1] = sign * ny * weight;
            mutual[2] = sign * (ny * lx - nx * ly) * weight;
            to_anchor[0] = ox * own;
            to_anchor[1] = oy * own;
            to_anchor[2] = (oy * lx - ox * ly) * own;
        }
    }
    for (Index a = 0; a < 6; a++) {
        for (Index t = 0; t < 3 * strides; t++)
            for (Index b = 0; b < 6; b++) after[6 * a + b] += rows[t][a] * rows[t][b];
        for (Index b = 0; b < 6; b++) after[6 * a + b] = information[6 * a + b] + after[6 * a + b];
        identity[7 * a] = 1.0;
    }
    if (!solutions(1, 6, 6, after, identity)) return 0;
    for (int i = 0; i < 2; i++) {
        const double *own = identity + 21 * i, dx = x[(i + 1) * strides - 1] - pose[3 * i];
        const double dy = y[(i + 1) * strides - 1] - pose[3 * i + 1];
        double variance = own[0] + own[7];
        variance += (dx * dx + dy * dy) * own[14];
        variance += 2.0 * (dx * own[8] - dy * own[2]);
        *cost += variance / by->squared_accuracy;
    }
    return 1;
}

/* Set the costs of `count` manoeuvres of the robot `moving` (0 or 1) while the other one executes that with the index
   `other`; returns 0 if the information is singular. */
int joint_costs(const Weighed *by, Index count, Index strides, const double *along, const double *across, Index moving,
                Index other, Index hypotheses, const double *probability, const double *poses, const double *anchors,
                const double *information, double *cost)
{
    double x[2 * strides], y[2 * strides], distances[hypotheses * strides];
    for (Index n = 0; n < count; n++) {
        cost[n] = 0.0;
        for (Index h = 0; h < hypotheses; h++) {
            double *distance = distances + h * strides, least = INFINITY;
            for (Index i = 0; i < 2; i++) {
                const Index way = strides * (i == moving ? n : other);
                ends_of(poses + 6 * h + 3 * i, strides, along + way, across + way, x + i * strides, y + i * strides);
            }
            for (Index t = 0; t < strides; t++) {
                distance[t] = larger(length(x[t] - x[strides + t], y[t] - y[strides + t]), SIGMA_FLOOR);
                least = distance[t] < least ? distance[t] : least;
            }
            const double off_anchor = length(x[strides] - anchors[2], y[strides] - anchors[3]);
            cost[n] += probability[h] * by->outside * larger(0.0, distance[0] - by->farthest);
            cost[n] += probability[h] * by->outside * larger(0.0, off_anchor - by->farthest);
            cost[n] += probability[h] * by->near * larger(0.0, by->nearest - least);
            cost[n] += probability[h] * by->near * larger(0.0, by->nearest_to_anchor - off_anchor);
            if (!h && !add_variance(by, strides, poses, x, y, distance, anchors, information, cost + n)) return 0;
        }
        cost[n] += confusion(by, hypotheses, probability, strides, distances);
    }
    cost[count - 1] += by->standing;
    return 1;
}
