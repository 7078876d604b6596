/* Roots of matrices of W lanes. */

/* The upper triangular factor of the QR factorisation of T (n, m) by Householder's reflections. What
   is below the diagonal is left as it is. */
SEPARATE void AT_WIDTH(triangle)(int n, int m, lanes *restrict T)
{
    for (int j = 0; j < m && j < n - 1; j++) {
        lanes below, scale, factor;
        EACH_LANE below[l] = 0;
        for (int i = j + 1; i < n; i++) EACH_LANE below[l] += T[i * m + j][l] * T[i * m + j][l];
        EACH_LANE {
            const double pivot = T[j * m + j][l], size = sqrt(pivot * pivot + below[l]);
            const double end = below[l] == 0 ? pivot : pivot > 0 ? -size : size;
            scale[l] = below[l] == 0 ? 0 : 1 / (pivot - end);
            factor[l] = below[l] == 0 ? 0 : (end - pivot) / end;
            T[j * m + j][l] = end;
        }
        for (int i = j + 1; i < n; i++) EACH_LANE T[i * m + j][l] *= scale[l];
        for (int k = j + 1; k < m; k++) {
            lanes part;
            EACH_LANE part[l] = T[j * m + k][l];
            for (int i = j + 1; i < n; i++)
                EACH_LANE part[l] += T[i * m + j][l] * T[i * m + k][l];
            EACH_LANE part[l] *= factor[l];
            EACH_LANE T[j * m + k][l] -= part[l];
            for (int i = j + 1; i < n; i++)
                EACH_LANE T[i * m + k][l] -= part[l] * T[i * m + j][l];
        }
    }
}

/* The lower triangular root of a covariance P (n, n) of noise; a pivot at or below zero is a zero
   with rounding error, and its column is zero. */
static inline void AT_WIDTH(noise_root)(int n, const lanes *restrict P, lanes *restrict L)
{
    for (int j = 0; j < n; j++) {
        lanes pivot;
        for (int i = 0; i < j; i++) EACH_LANE L[i * n + j][l] = 0;
        for (int i = j; i < n; i++) {
            lanes rest;
            EACH_LANE rest[l] = P[i * n + j][l];
            for (int q = 0; q < j; q++) EACH_LANE rest[l] -= L[i * n + q][l] * L[j * n + q][l];
            if (i == j) EACH_LANE pivot[l] = rest[l] <= 0 ? INFINITY : sqrt(rest[l]);
            EACH_LANE L[i * n + j][l] = rest[l] / pivot[l];
        }
    }
}

/* b = T^-1 b (n, m) for lower triangular T, the upper left corner of rows of ``width``; a component
   with a zero pivot is zero, for it has no variance. */
static inline void AT_WIDTH(substitute)(int n, int m, const lanes *restrict T, int width,
                                        lanes *restrict b)
{
    for (int i = 0; i < n; i++)
        for (int k = 0; k < m; k++) {
            for (int q = 0; q < i; q++)
                EACH_LANE b[i * m + k][l] -= T[i * width + q][l] * b[q * m + k][l];
            EACH_LANE b[i * m + k][l] =
                T[i * width + i][l] == 0 ? 0 : b[i * m + k][l] / T[i * width + i][l];
        }
}
