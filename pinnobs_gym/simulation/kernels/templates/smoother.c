/* The smoother of Rauch, Tung and Striebel, as pinnobs_gym/estimation/smoother.py says. */

/* Mark the lanes in which P = L L^T (NX, NX) may be too near to singular: of its correlations, the
   least eigenvalue may be less than ``least``, or P has no root.

   The determinant of correlations is not greater than that eigenvalue times e. Where this does not
   tell, the trace of the inverse does, which is not less than the eigenvalue's inverse. NumPy
   computes the eigenvalue itself in the rows that are marked. */
SEPARATE void AT_WIDTH(mark_near)(const lanes *restrict P, const double *restrict determinant,
                                  double least, int64_t *restrict near)
{
    lanes L[NX * NX], inverse[NX * NX];
    double trace[W];
    AT_WIDTH(cholesky)(NX, P, L);
    EACH_LANE trace[l] = 0;
    for (int j = 0; j < NX; j++) /* column j of the inverse of the correlations' root */
        for (int i = j; i < NX; i++) {
            double rest[W];
            EACH_LANE rest[l] = i == j ? sqrt(P[i * NX + i][l]) : 0;
            for (int q = j; q < i; q++)
                EACH_LANE rest[l] -= L[i * NX + q][l] * inverse[q * NX + j][l];
            EACH_LANE inverse[i * NX + j][l] = rest[l] / L[i * NX + i][l];
            EACH_LANE trace[l] += inverse[i * NX + j][l] * inverse[i * NX + j][l];
        }
    /* one per cent for the rounding errors of a matrix so near to singular */
    EACH_LANE near[l] |= !(determinant[l] > 2.72 * least) & !(trace[l] * least < 0.99);
}

#ifndef STRAIGHT
static void AT_WIDTH(smooth_step)(const lanes *restrict F, const lanes *restrict Q,
                                  const lanes *restrict x_ahead, const lanes *restrict P_ahead,
                                  const lanes *restrict x_next, const lanes *restrict P_next,
                                  lanes *restrict x, lanes *restrict P,
                                  double *restrict determinant)
{
    lanes L[NX * NX], C[NX * NX], M[NX * NX], rest[NX * NX], moved[NX], step[NX];
    AT_WIDTH(cholesky)(NX, P_ahead, L);
    EACH_LANE determinant[l] = 1;
    for (int i = 0; i < NX; i++)
        EACH_LANE determinant[l] *= L[i * NX + i][l] * L[i * NX + i][l] / P_ahead[i * NX + i][l];
    AT_WIDTH(outer)(NX, NX, NX, P, F, C);
    AT_WIDTH(divide_factored)(NX, NX, C, L);
    for (int i = 0; i < NX; i++) EACH_LANE moved[i][l] = x_next[i][l] - x_ahead[i][l];
    AT_WIDTH(product)(NX, NX, 1, C, moved, step);
    for (int i = 0; i < NX; i++) EACH_LANE x[i][l] += step[i][l];
    AT_WIDTH(product)(NX, NX, NX, C, F, M);
    for (int i = 0; i < NX * NX; i++) {
        EACH_LANE M[i][l] = (i % (NX + 1) == 0) - M[i][l];
        EACH_LANE rest[i][l] = P_next[i][l] + Q[i][l];
    }
    AT_WIDTH(sandwich)(NX, M, P);
    AT_WIDTH(sandwich)(NX, C, rest);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += rest[i][l];
}
#endif

/* Smooth the estimates of a filter, W rows in arrays of W rows, which x and P of the call are
   overwritten by. With C = P F^T (P^-')^-1, where primes mark the next sample:
   x = x + C (x' - x^-') and P = (I - C F) P (I - C F)^T + C (P' + Q) C^T. The lanes that are left to
   NumPy are marked in ``near``. */
SEPARATE void AT_WIDTH(smooth_rows)(const struct call *c, double least, int64_t *restrict near)
{
    const double sure = 2.72 * least; /* e */
    for (int64_t k = c->samples - 2; k >= 0; k--) {
        lanes *x = (lanes *)c->x + k * NX, *P = (lanes *)c->P + k * NX * NX;
        const int64_t place = (k + 1) * NX * NX;
        const lanes *P_ahead = (const lanes *)c->P_predicted + place;
        double determinant[W];
        int all = 1;
        AT_WIDTH(smooth_step)((const lanes *)c->F + place, (const lanes *)c->Q + place,
                              (const lanes *)c->x_predicted + (k + 1) * NX, P_ahead, x + NX,
                              P + NX * NX, x, P, determinant);
        EACH_LANE all &= determinant[l] > sure;
        if (!all) AT_WIDTH(mark_near)(P_ahead, determinant, least, near);
    }
}
