/* The motion of the model from one sample to the next, as pinnobs_gym/simulation/model.py says. */

/* P = P + B L L^T B^T w for B (NX, NX) */
static inline void AT_WIDTH(add_noise)(const struct plan *plan, const lanes *restrict B, double w,
                                       lanes *restrict P)
{
    const int m = (int)plan->m;
    for (int c = 0; c < m; c++) {
        lanes BL[NX];
        for (int i = 0; i < NX; i++) {
            EACH_LANE BL[i][l] = 0;
            for (int j = 0; j < NX; j++) {
                const double entry = plan->L[j * m + c];
                if (entry != 0) EACH_LANE BL[i][l] += B[i * NX + j][l] * entry;
            }
        }
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NX; j++) EACH_LANE P[i * NX + j][l] += w * (BL[i][l] * BL[j][l]);
    }
}

/* P = P + w L L^T */
static inline void AT_WIDTH(add_density)(const struct plan *plan, double w, lanes *restrict P)
{
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += w * plan->D[i];
}

/* Move P over a Runge-Kutta step, as said for move_moments. */
SEPARATE void AT_WIDTH(add_noisy_step)(const struct plan *plan, double h,
                                            const lanes *restrict F, const lanes *restrict A_first,
                                            const lanes *restrict A_last, lanes *restrict P)
{
    lanes twice[NX * NX]; /* two times Psi at the middle */
    AT_WIDTH(sandwich)(NX, F, P);
    AT_WIDTH(product)(NX, NX, NX, F, A_first, twice);
    for (int i = 0; i < NX * NX; i++)
        EACH_LANE twice[i][l] = (A_last[i][l] - twice[i][l]) * (h / 4) + F[i][l];
    for (int i = 0; i < NX; i++) EACH_LANE twice[i * NX + i][l] += 1;
    AT_WIDTH(add_noise)(plan, F, h / 6, P);
    AT_WIDTH(add_noise)(plan, twice, h / 6, P);
    AT_WIDTH(add_density)(plan, h / 6, P);
}

/* Move x (NX) over an interval. */
static inline void AT_WIDTH(move)(const struct interval *over, lanes *restrict x)
{
    if (over->plan->discrete) {
        for (seconds k = over->t0; k < over->t1; k++) {
            lanes t, u[LU], next[NX];
            EACH_LANE t[l] = k;
            AT_WIDTH(input_at)(over, k, (k - over->t0) / (over->t1 - over->t0), u);
            AT_WIDTH(plant_f)(t, x, u, over->p, next);
            memcpy(x, next, sizeof next);
        }
        return;
    }
    struct steps at = {.begun = 0};
    struct rk_step s = {.h = 0};
    while (AT_WIDTH(next_step)(over, &at, &s)) AT_WIDTH(runge_kutta)(&s, over->p, x);
}

/* Move x and its covariance P over an interval: P = F P F^T + Q, where
   Q = integral of Psi L L^T Psi^T by Simpson's rule, whose weights are 1/6, 4/6 and 1/6 at the
   start, the middle and the end of a step. Psi at the middle of a step is the cubic
   Hermite polynomial through its values and slopes -Psi A at the ends. If ``F`` is given, it is
   multiplied by the Jacobian. */
SEPARATE void AT_WIDTH(move_moments)(const struct interval *over, lanes *restrict x,
                                          lanes *restrict P, lanes *restrict F)
{
    lanes step_F[NX * NX], A_first[NX * NX], A_last[NX * NX];
    if (over->plan->discrete) {
        for (seconds k = over->t0; k < over->t1; k++) {
            lanes t, u[LU], next[NX];
            EACH_LANE t[l] = k;
            AT_WIDTH(input_at)(over, k, (k - over->t0) / (over->t1 - over->t0), u);
            AT_WIDTH(plant_f_linearised)(t, x, u, over->p, next, step_F);
            memcpy(x, next, sizeof next);
            AT_WIDTH(add_map_step)(over->plan->D, step_F, P);
            if (F) {
                AT_WIDTH(product)(NX, NX, NX, step_F, F, A_first);
                memcpy(F, A_first, sizeof A_first);
            }
        }
        return;
    }
    struct steps at = {.begun = 0};
    struct rk_step s = {.h = 0};
    while (AT_WIDTH(next_step)(over, &at, &s)) {
        AT_WIDTH(runge_kutta_linearised)(&s, over->p, x, step_F, A_first, A_last);
#ifdef STRAIGHT
        if (over->plan->diagonal)
            AT_WIDTH(add_step)(s.h, over->plan->D, step_F, A_first, A_last, P);
        else
#endif
            AT_WIDTH(add_noisy_step)(over->plan, s.h, step_F, A_first, A_last, P);
        if (F) {
            AT_WIDTH(product)(NX, NX, NX, step_F, F, A_first);
            memcpy(F, A_first, sizeof A_first);
        }
    }
}
