/* X = A M^-1 for A (n, m) and M (m, m), by elimination with the largest pivot; A is overwritten by X,
   and M by what is left of it. NAN if M is singular. */
static void right_divide(int n, int m, double *A, double *M)
{
    for (int c = 0; c < m; c++) { /* M^T X^T = A^T, column by column */
        int pivot = c;
        for (int k = c + 1; k < m; k++)
            if (fabs(M[c * m + k]) > fabs(M[c * m + pivot])) pivot = k;
        for (int k = 0; k < m; k++) {
            const double swapped = M[k * m + c];
            M[k * m + c] = M[k * m + pivot];
            M[k * m + pivot] = swapped;
        }
        for (int i = 0; i < n; i++) {
            const double swapped = A[i * m + c];
            A[i * m + c] = A[i * m + pivot];
            A[i * m + pivot] = swapped;
        }
        for (int k = c + 1; k < m; k++) {
            const double factor = M[c * m + k] / M[c * m + c];
            for (int r = c; r < m; r++) M[r * m + k] -= factor * M[r * m + c];
            for (int i = 0; i < n; i++) A[i * m + k] -= factor * A[i * m + c];
        }
    }
    for (int i = 0; i < n; i++)
        for (int c = m - 1; c >= 0; c--) {
            for (int k = c + 1; k < m; k++) A[i * m + c] -= A[i * m + k] * M[k * m + c];
            A[i * m + c] /= M[c * m + c];
        }
}
