/* The functions of elementary.py: those of the C library for each element, and linear algebra of small matrices.

   Matrices are stored row by row. Results follow from this text and from the C library alone. */

#include <math.h>
#include <string.h>

typedef long long Index;

#define OF_EACH(name, function)                                                  \
    void name(Index count, const double *x, double *to)                          \
    {                                                                            \
        for (Index e = 0; e < count; e++) to[e] = function(x[e]);                \
    }

OF_EACH(each_exp, exp)
OF_EACH(each_log, log)
OF_EACH(each_cos, cos)
OF_EACH(each_sin, sin)
OF_EACH(each_tan, tan)

/* log(exp(one) + exp(other)) */
void each_logaddexp(Index count, const double *one, const double *other, double *to)
{
    for (Index e = 0; e < count; e++) {
        const double most = one[e] > other[e] ? one[e] : other[e];
        to[e] = one[e] == other[e] ? most + M_LN2 : most + log1p(exp(-fabs(one[e] - other[e])));
    }
}

/* Products of `count` matrices of p rows and q columns with those of q rows and r columns; consecutive ones
   begin `left_step` and `right_step` elements apart, 0 for one matrix. */
void products(
    Index count, Index p, Index q, Index r, const double *left, Index left_step, const double *right,
    Index right_step, double *to)
{
    memset(to, 0, sizeof(double) * count * p * r);
    for (Index n = 0; n < count; n++, left += left_step, right += right_step, to += p * r)
        for (Index a = 0; a < p; a++)
            for (Index b = 0; b < q; b++) {
                const double factor = left[a * q + b];
                for (Index c = 0; c < r; c++) to[a * r + c] += factor * right[b * r + c];
            }
}

/* Solves `count` systems of `size` equations with `columns` right sides by Gaussian elimination with row
   pivots. `matrix` is overwritten, and `right` becomes the solutions. Returns 0 if a matrix is singular. */
int solutions(Index count, Index size, Index columns, double *matrix, double *right)
{
    for (Index n = 0; n < count; n++, matrix += size * size, right += size * columns)
        for (Index turn = 0; turn < 2 * size; turn++) {
            const Index a = turn < size ? turn : 2 * size - 1 - turn;
            double *row = matrix + a * size, *own = right + a * columns;
            if (turn >= size) { /* substitution backwards */
                for (Index b = a + 1; b < size; b++)
                    for (Index c = 0; c < columns; c++) own[c] -= row[b] * right[b * columns + c];
                for (Index c = 0; c < columns; c++) own[c] /= row[a];
                continue;
            }
            Index pivot = a;
            for (Index b = a + 1; b < size; b++)
                if (fabs(matrix[b * size + a]) > fabs(matrix[pivot * size + a])) pivot = b;
            if (!(fabs(matrix[pivot * size + a]) > 0.0)) return 0;
            for (Index c = a; c < size && pivot != a; c++) {
                const double kept = row[c];
                row[c] = matrix[pivot * size + c], matrix[pivot * size + c] = kept;
            }
            for (Index c = 0; c < columns && pivot != a; c++) {
                const double kept = own[c];
                own[c] = right[pivot * columns + c], right[pivot * columns + c] = kept;
            }
            for (Index b = a + 1; b < size; b++) {
                const double factor = matrix[b * size + a] / row[a];
                for (Index c = a + 1; c < size; c++) matrix[b * size + c] -= factor * row[c];
                for (Index c = 0; c < columns; c++) right[b * columns + c] -= factor * own[c];
            }
        }
    return 1;
}

#define MOST_SWEEPS 50

/* The eigenvalues on the diagonal of the symmetric `matrix`, which is overwritten, and the eigenvectors as the
   columns of `vectors`, by Jacobi's rotations (Golub and Van Loan, section 8.5). */
void eigen(Index size, double *matrix, double *vectors)
{
    memset(vectors, 0, sizeof(double) * size * size);
    for (Index a = 0; a < size; a++) vectors[a * size + a] = 1.0;
    for (int sweep = 0; sweep < MOST_SWEEPS; sweep++) {
        int rotated = 0;
        for (Index a = 0; a < size; a++)
            for (Index b = a + 1; b < size; b++) {
                const double off = matrix[a * size + b];
                const double one = matrix[a * size + a], other = matrix[b * size + b];
                if (fabs(one) + fabs(off) == fabs(one) && fabs(other) + fabs(off) == fabs(other)) {
                    matrix[a * size + b] = matrix[b * size + a] = 0.0;
                    continue;
                }
                if (!(off != 0.0)) continue;
                rotated = 1;
                const double ratio = (other - one) / (2.0 * off);
                const double t = (ratio >= 0.0 ? 1.0 : -1.0) / (fabs(ratio) + sqrt(1.0 + ratio * ratio));
                const double c = 1.0 / sqrt(1.0 + t * t), s = t * c;
                for (Index k = 0; k < size; k++) {
                    const double left = matrix[k * size + a], right = matrix[k * size + b];
                    matrix[k * size + a] = c * left - s * right, matrix[k * size + b] = s * left + c * right;
                }
                for (Index k = 0; k < size; k++) {
                    const double left = matrix[a * size + k], right = matrix[b * size + k];
                    matrix[a * size + k] = c * left - s * right, matrix[b * size + k] = s * left + c * right;
                    const double from = vectors[k * size + a], with = vectors[k * size + b];
                    vectors[k * size + a] = c * from - s * with, vectors[k * size + b] = s * from + c * with;
                }
            }
        if (!rotated) return;
    }
}
