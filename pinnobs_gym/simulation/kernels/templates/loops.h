/* The functions of steps.h in loops, for plants of which step_code.py would write too much code. */
/* The place in ``t`` and ``u`` of each stage */
static const int AT_WIDTH(stage)[4] = {0, 1, 1, 2};
#define STAGE AT_WIDTH(stage)

static inline void AT_WIDTH(runge_kutta)(const struct rk_step *s, const lanes *p, lanes *restrict x)
{
    lanes k[4][NX], point[NX];
    const double h = s->h, part[4] = {0, h / 2, h / 2, h};
    for (int q = 0; q < 4; q++) {
        if (q == 0) memcpy(point, x, sizeof point);
        else
            for (int i = 0; i < NX; i++) EACH_LANE point[i][l] = part[q] * k[q - 1][i][l] + x[i][l];
        AT_WIDTH(plant_f)((const double *)(s->t + STAGE[q]), point, s->u[STAGE[q]], p, k[q]);
    }
    for (int i = 0; i < NX; i++)
        EACH_LANE x[i][l] += h / 6 * ((k[1][i][l] + k[2][i][l]) * 2 + k[0][i][l] + k[3][i][l]);
}

static inline void AT_WIDTH(runge_kutta_linearised)(const struct rk_step *s, const lanes *p,
                                                    lanes *restrict x, lanes *restrict F,
                                                    lanes *restrict A_first,
                                                    lanes *restrict A_last)
{
    lanes k[4][NX], point[NX], A[NX * NX], Phi[NX * NX], K[NX * NX];
    const double h = s->h, part[4] = {0, h / 2, h / 2, h}, weight[4] = {1, 2, 2, 1};
    for (int q = 0; q < 4; q++) {
        if (q == 0) memcpy(point, x, sizeof point);
        else
            for (int i = 0; i < NX; i++) EACH_LANE point[i][l] = part[q] * k[q - 1][i][l] + x[i][l];
        AT_WIDTH(plant_f_linearised)((const double *)(s->t + STAGE[q]), point,
                                     s->u[STAGE[q]], p, k[q],
                                     q == 0 ? A_first : q == 3 ? A_last : A);
        if (q == 0) { /* Phi = I at the start */
            memcpy(K, A_first, sizeof K);
            for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] = K[i][l];
        } else {
            for (int i = 0; i < NX * NX; i++) EACH_LANE Phi[i][l] = part[q] * K[i][l];
            for (int i = 0; i < NX; i++) EACH_LANE Phi[i * NX + i][l] += 1;
            AT_WIDTH(product)(NX, NX, NX, q == 3 ? A_last : A, Phi, K);
            for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] += weight[q] * K[i][l];
        }
    }
    for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] *= h / 6;
    for (int i = 0; i < NX; i++) EACH_LANE F[i * NX + i][l] += 1;
    for (int i = 0; i < NX; i++)
        EACH_LANE x[i][l] += h / 6 * ((k[1][i][l] + k[2][i][l]) * 2 + k[0][i][l] + k[3][i][l]);
}

static inline void AT_WIDTH(add_map_step)(const double *restrict D, const lanes *restrict F,
                                          lanes *restrict P)
{
    AT_WIDTH(sandwich)(NX, F, P);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += D[i];
}

static inline void AT_WIDTH(output_moments)(const lanes *restrict H, const lanes *restrict P,
                                            const lanes *restrict R, lanes *restrict HP,
                                            lanes *restrict S)
{
    AT_WIDTH(product)(NY, NX, NX, H, P, HP);
    AT_WIDTH(symmetric)(NY, NX, HP, H, S);
    for (int i = 0; i < NY * NY; i++) EACH_LANE S[i][l] += R[i][l];
}

static inline void AT_WIDTH(kalman_update)(const lanes *restrict H, const lanes *restrict HP,
                                           const lanes *restrict S, const lanes *restrict R,
                                           const lanes *restrict e, lanes *restrict x,
                                           lanes *restrict P, double *restrict rest)
{
    lanes L[NY * NY], K[NX * NY], step[NX], M[NX * NX], KR[NX * NY], noise[NX * NX];
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NY; j++) EACH_LANE K[i * NY + j][l] = HP[j * NX + i][l];
    AT_WIDTH(cholesky)(NY, S, L);
    AT_WIDTH(divide_factored)(NX, NY, K, L);
    AT_WIDTH(product)(NX, NY, NX, K, H, M);
    for (int i = 0; i < NX * NX; i++) EACH_LANE M[i][l] = -M[i][l];
    for (int i = 0; i < NX; i++) EACH_LANE M[i * NX + i][l] += 1;
    AT_WIDTH(sandwich)(NX, M, P);
    AT_WIDTH(product)(NX, NY, NY, K, R, KR);
    AT_WIDTH(symmetric)(NX, NY, KR, K, noise);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += noise[i][l];
    AT_WIDTH(product)(NX, NY, 1, K, e, step);
    for (int i = 0; i < NX; i++) EACH_LANE x[i][l] += step[i][l];
    EACH_LANE rest[l] = 0;
    for (int i = 0; i < NX; i++) EACH_LANE rest[l] += x[i][l];
    for (int i = 0; i < NX * NX; i++) EACH_LANE rest[l] += P[i][l];
    EACH_LANE rest[l] -= rest[l];
}
