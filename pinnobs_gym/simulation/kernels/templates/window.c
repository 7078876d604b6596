/* A moving window whose states all follow from the first one, as
   pinnobs_gym/estimation/exact_window.py says. Lanes that are left to NumPy are marked in ``bad``. */

/* What is known of W rows: the prior of the window's first state, and its estimate. */
#define first_state AT_WIDTH(first_state)
struct first_state {
    lanes mean[NX], P[NX * NX], x[NX];
};

/* The fit of the model to the outputs of a window: the last state, its derivatives Phi by the first,
   the last sample, and the normal equations. */
#define fit AT_WIDTH(fit)
struct fit {
    lanes x[NX], Phi[NX * NX], H[NY * NX], information[NX * NX], right[NX];
    struct sample last;
};

/* Move x over an interval, and derivatives Phi of it. */
static inline void AT_WIDTH(move_linearised)(const struct interval *over, lanes *restrict x,
                                             lanes *restrict Phi)
{
    lanes F[NX * NX], first[NX * NX], last[NX * NX];
    if (over->plan->discrete) {
        for (seconds k = over->t0; k < over->t1; k++) {
            lanes t, u[LU], next[NX];
            EACH_LANE t[l] = k;
            AT_WIDTH(input_at)(over, k, (k - over->t0) / (over->t1 - over->t0), u);
            AT_WIDTH(plant_f_linearised)(t, x, u, over->p, next, F);
            memcpy(x, next, sizeof next);
            AT_WIDTH(product)(NX, NX, NX, F, Phi, first);
            memcpy(Phi, first, sizeof first);
        }
        return;
    }
    struct steps at = {.begun = 0};
    struct rk_step s = {.h = 0};
    while (AT_WIDTH(next_step)(over, &at, &s)) {
        AT_WIDTH(runge_kutta_linearised)(&s, over->p, x, F, first, last);
        AT_WIDTH(product)(NX, NX, NX, F, Phi, first);
        memcpy(Phi, first, sizeof first);
    }
}

/* Take the first sample out of the window: the prior is updated with it, with the output linearised
   about the estimate, and moved to the second sample with it. */
SEPARATE void AT_WIDTH(shorten)(const struct window *c, const lanes *restrict p, int64_t row,
                                int count, struct first_state *restrict w)
{
    struct interval over = {.plan = c->plan, .p = p};
    struct sample s, next;
    lanes offset[NX], H[NY * NX], HP[NY * NX], F[NX * NX], moved[NX];
    double rest[W];
    AT_WIDTH(load_sample)(c, 0, row, count, &s);
    AT_WIDTH(load_sample)(c, 1, row, count, &next);
    AT_WIDTH(observe)(c->plan, p, w->x, &s, H);
    AT_WIDTH(state_residual)(c->plan, w->mean, w->x, offset);
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NX; j++) EACH_LANE s.e[i][l] -= H[i * NX + j][l] * offset[j][l];
    AT_WIDTH(output_moments)(H, w->P, s.R, HP, s.S);
    AT_WIDTH(kalman_update)(H, HP, s.S, s.R, s.e, offset, w->P, rest);
    AT_WIDTH(set_interval)(c, 1, &s, &next, &over);
    for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] = i % (NX + 1) == 0;
    AT_WIDTH(move_moments)(&over, w->x, w->P, F);
    AT_WIDTH(product)(NX, NX, 1, F, offset, moved);
    for (int i = 0; i < NX; i++) EACH_LANE w->mean[i][l] = w->x[i][l] + moved[i][l];
}

/* Move the model through the window from its first state, and form the normal equations: with G = H
   Phi, information is the sum of G^T R^-1 G, and right that of G^T R^-1 e. */
SEPARATE void AT_WIDTH(fit_window)(const struct window *c, int64_t begin, const lanes *restrict p,
                                   int64_t row, int count, const lanes *restrict start,
                                   struct fit *restrict f, int64_t *restrict bad)
{
    struct interval over = {.plan = c->plan, .p = p};
    struct sample now;
    memcpy(f->x, start, sizeof f->x);
    for (int i = 0; i < NX * NX; i++) {
        EACH_LANE f->Phi[i][l] = i % (NX + 1) == 0;
        EACH_LANE f->information[i][l] = 0;
    }
    for (int i = 0; i < NX; i++) EACH_LANE f->right[i][l] = 0;
    for (int64_t k = begin; k < c->samples; k++) {
        lanes G[NY * NX], weighted[NX * NY];
        AT_WIDTH(load_sample)(c, k, row, count, &now);
        if (k > begin) {
            AT_WIDTH(set_interval)(c, k, &f->last, &now, &over);
            AT_WIDTH(move_linearised)(&over, f->x, f->Phi);
        }
        f->last = now;
        AT_WIDTH(observe)(c->plan, p, f->x, &f->last, f->H);
        AT_WIDTH(product)(NY, NX, NX, f->H, f->Phi, G);
        for (int i = 0; i < NX; i++)
            for (int j = 0; j < NY; j++) EACH_LANE weighted[i * NY + j][l] = G[j * NX + i][l];
        AT_WIDTH(divide)(NX, f->last.R, weighted, bad);
        for (int i = 0; i < NX; i++) {
            for (int q = 0; q < NY; q++)
                EACH_LANE f->right[i][l] += weighted[i * NY + q][l] * f->last.e[q][l];
            for (int j = 0; j < NX; j++)
                for (int q = 0; q < NY; q++)
                    EACH_LANE f->information[i * NX + j][l] +=
                        weighted[i * NY + q][l] * G[q * NX + j][l];
        }
    }
}

/* Find the Gauss-Newton step of the first state, and the covariance C = (P^-1 + information)^-1 =
   L (I + L^T information L)^-1 L^T of the result, where P = L L^T is that of its prior. */
SEPARATE void AT_WIDTH(newton_step)(const struct plan *plan, const struct first_state *restrict w,
                              const struct fit *restrict f, lanes *restrict step,
                              lanes *restrict C, int64_t *restrict bad)
{
    lanes L[NX * NX], L_T[NX * NX], inner[NX * NX], root[NX * NX], offset[NX], right[NX];
    AT_WIDTH(cholesky)(NX, w->P, L);
    AT_WIDTH(mark_without_root)(NX, w->P, L, bad);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) EACH_LANE L_T[i * NX + j][l] = L[j * NX + i][l];
    AT_WIDTH(product)(NX, NX, NX, L_T, f->information, C);
    AT_WIDTH(product)(NX, NX, NX, C, L, inner);
    for (int i = 0; i < NX; i++) EACH_LANE inner[i * NX + i][l] += 1;
    AT_WIDTH(cholesky)(NX, inner, root);
    AT_WIDTH(mark_without_root)(NX, inner, root, bad);
    AT_WIDTH(divide_factored)(NX, NX, L, root);
    AT_WIDTH(product)(NX, NX, NX, L, L_T, C);
    AT_WIDTH(state_residual)(plan, w->mean, w->x, offset);
    AT_WIDTH(product)(NX, NX, 1, f->information, offset, right);
    for (int i = 0; i < NX; i++) EACH_LANE right[i][l] = f->right[i][l] - right[i][l];
    AT_WIDTH(product)(NX, NX, 1, C, right, step);
    for (int i = 0; i < NX; i++) EACH_LANE step[i][l] += offset[i][l];
}

/* S = R (R - H P H^T)^-1 R, from the covariance P after the update */
static inline void AT_WIDTH(innovation_covariance)(const lanes *restrict P, const lanes *restrict H,
                                                   const lanes *restrict R, lanes *restrict S,
                                                   int64_t *restrict bad)
{
    lanes HP[NY * NX], inner[NY * NY], X[NY * NY], whole[NY * NY];
    AT_WIDTH(product)(NY, NX, NX, H, P, HP);
    AT_WIDTH(outer)(NY, NX, NY, HP, H, inner);
    for (int i = 0; i < NY * NY; i++) {
        EACH_LANE inner[i][l] = R[i][l] - inner[i][l];
        EACH_LANE X[i][l] = R[i][l];
    }
    AT_WIDTH(divide)(NY, inner, X, bad);
    AT_WIDTH(product)(NY, NY, NY, X, R, whole);
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++)
            EACH_LANE S[i * NY + j][l] = (whole[i * NY + j][l] + whole[j * NY + i][l]) / 2;
}

/* Take the last sample of the call into W rows' windows, of which ``count`` exist. */
static void AT_WIDTH(window_rows)(const struct window *c, int64_t row, int count)
{
    const int64_t batch = c->batch, begin = c->samples > c->most;
    const struct plan *plan = c->plan;
    lanes p[LP], step[NX], C[NX * NX], H[NY * NX], R[NY * NY], moved[NX], S[NY * NY];
    struct first_state w;
    struct fit f;
    int64_t bad[W];
    AT_WIDTH(load)(NP, plan->p, plan->p_rows ? batch : 0, row, count, p);
    AT_WIDTH(load)(NX, c->mean, batch, row, count, w.mean);
    AT_WIDTH(load)(NX * NX, c->P, batch, row, count, w.P);
    AT_WIDTH(load)(NX, c->start, batch, row, count, w.x);
    EACH_LANE bad[l] = 0;
    if (begin) AT_WIDTH(shorten)(c, p, row, count, &w);
    AT_WIDTH(fit_window)(c, begin, p, row, count, w.x, &f, bad);
    /* The trajectory from the previous first state ends at the prediction of the last sample. */
    memcpy(H, f.H, sizeof H);
    memcpy(R, f.last.R, sizeof R);
    AT_WIDTH(store)(NY, f.last.e, c->innovation, batch, row, count);
    AT_WIDTH(newton_step)(plan, &w, &f, step, C, bad);
    for (int64_t n = 1;; n++) {
        for (int i = 0; i < NX; i++) {
            EACH_LANE w.x[i][l] += step[i][l];
            if (plan->low) EACH_LANE bad[l] |= (w.x[i][l] < plan->low[i]) | (w.x[i][l] > plan->high[i]);
        }
        if (n == c->rounds) break;
        AT_WIDTH(fit_window)(c, begin, p, row, count, w.x, &f, bad);
        AT_WIDTH(newton_step)(plan, &w, &f, step, C, bad);
    }
    /* Map the last step to the last sample to first order, without a new trajectory. */
    AT_WIDTH(product)(NX, NX, 1, f.Phi, step, moved);
    for (int i = 0; i < NX; i++) EACH_LANE f.x[i][l] += moved[i][l];
    AT_WIDTH(sandwich)(NX, f.Phi, C);
    AT_WIDTH(innovation_covariance)(C, H, R, S, bad);
    AT_WIDTH(store)(NY * NY, S, c->S, batch, row, count);
    AT_WIDTH(store)(NX, f.x, c->x, batch, row, count);
    AT_WIDTH(store)(NX * NX, C, c->P_x, batch, row, count);
    AT_WIDTH(store)(NX, w.mean, c->mean_after, batch, row, count);
    AT_WIDTH(store)(NX * NX, w.P, c->P_after, batch, row, count);
    AT_WIDTH(store)(NX, w.x, c->start_after, batch, row, count);
    /* NumPy says where values that are not finite go. */
    for (int i = 0; i < NX * NX; i++) EACH_LANE bad[l] |= !isfinite(C[i][l]) | !isfinite(w.P[i][l]);
    for (int i = 0; i < NX; i++) EACH_LANE bad[l] |= !isfinite(f.x[i][l]) | !isfinite(w.mean[i][l]);
    for (int l = 0; l < count; l++) c->left[row + l] |= bad[l] != 0;
}
