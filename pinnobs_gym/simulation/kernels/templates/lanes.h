/* Small matrices of W lanes: episodes side by side in the innermost loop.

   Arrays are (rows, columns, W). Every lane has the same operations in the same order for any W,
   and no operation is contracted or reordered, so that an episode gives the same result to the last
   bit alone and in any batch. Sums are formed in the order of the index. */
#define lanes AT_WIDTH(lanes)
typedef double lanes[W];
#define EACH_LANE for (int l = 0; l < W; l++)

/* c = a b for a (n, k) and b (k, m) */
static inline void AT_WIDTH(product)(int n, int k, int m, const lanes *restrict a,
                                     const lanes *restrict b, lanes *restrict c)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++) {
            double sum[W];
            EACH_LANE sum[l] = a[i * k][l] * b[j][l];
            for (int q = 1; q < k; q++) EACH_LANE sum[l] += a[i * k + q][l] * b[q * m + j][l];
            EACH_LANE c[i * m + j][l] = sum[l];
        }
}

/* c = a b^T for a (n, k) and b (m, k) */
static inline void AT_WIDTH(outer)(int n, int k, int m, const lanes *restrict a,
                                   const lanes *restrict b, lanes *restrict c)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < m; j++) {
            double sum[W];
            EACH_LANE sum[l] = a[i * k][l] * b[j * k][l];
            for (int q = 1; q < k; q++) EACH_LANE sum[l] += a[i * k + q][l] * b[j * k + q][l];
            EACH_LANE c[i * m + j][l] = sum[l];
        }
}

/* The symmetric c = a b^T, of which the lower half is computed, for a and b (n, k) */
static inline void AT_WIDTH(symmetric)(int n, int k, const lanes *restrict a,
                                       const lanes *restrict b, lanes *restrict c)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double sum[W];
            EACH_LANE sum[l] = a[i * k][l] * b[j * k][l];
            for (int q = 1; q < k; q++) EACH_LANE sum[l] += a[i * k + q][l] * b[j * k + q][l];
            EACH_LANE c[i * n + j][l] = c[j * n + i][l] = sum[l];
        }
}

/* P = M P M^T for M (n, n), whose result is symmetric */
static inline void AT_WIDTH(sandwich)(int n, const lanes *restrict M, lanes *restrict P)
{
    lanes MP[NX * NX];
    AT_WIDTH(product)(n, n, n, M, P, MP);
    AT_WIDTH(symmetric)(n, n, MP, M, P);
}

/* Lower triangular L with L L^T = P (n, n); NaN where P is not positive definite. */
static inline void AT_WIDTH(cholesky)(int n, const lanes *restrict P, lanes *restrict L)
{
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < j; i++) EACH_LANE L[i * n + j][l] = 0;
        double pivot[W] = {0};
        for (int i = j; i < n; i++) {
            double rest[W];
            EACH_LANE rest[l] = P[i * n + j][l];
            for (int q = 0; q < j; q++) EACH_LANE rest[l] -= L[i * n + q][l] * L[j * n + q][l];
            if (i == j) EACH_LANE pivot[l] = sqrt(rest[l] > 0 ? rest[l] : NAN);
            EACH_LANE L[i * n + j][l] = rest[l] / pivot[l];
        }
    }
}

/* X = A (L L^T)^-1 for A (n, m) and L (m, m) lower triangular; A is overwritten by X. */
static inline void AT_WIDTH(divide_factored)(int n, int m, lanes *restrict A,
                                             const lanes *restrict L)
{
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < m; j++) { /* forward substitution */
            for (int q = 0; q < j; q++)
                EACH_LANE A[i * m + j][l] -= A[i * m + q][l] * L[j * m + q][l];
            EACH_LANE A[i * m + j][l] /= L[j * m + j][l];
        }
        for (int j = m - 1; j >= 0; j--) { /* back substitution */
            for (int q = j + 1; q < m; q++)
                EACH_LANE A[i * m + j][l] -= A[i * m + q][l] * L[q * m + j][l];
            EACH_LANE A[i * m + j][l] /= L[j * m + j][l];
        }
    }
}
