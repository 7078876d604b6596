/* A moving window whose states are all unknown, as pinnobs_gym/estimation/moving_window.py says. Lanes
   that are left to NumPy are marked in ``bad``. */
#include <stdlib.h>

/* What is known of W rows' windows: the linearised model at each sample, the mean of the first state
   and what is known of it before its sample, less r. */
#define moving AT_WIDTH(moving)
struct moving {
    struct linear *at;
    lanes p[LP], mean[NX];
    struct earlier first;
};

/* Load the windows of W rows, of which ``count`` exist. The last state is the prediction of the new
   sample. */
static inline void AT_WIDTH(load_window)(const struct window *c, int64_t row, int count,
                                         struct moving *restrict w)
{
    const int64_t batch = c->batch, last = c->samples - 1;
    const struct plan *plan = c->plan;
    struct interval over = {.plan = plan, .p = w->p};
    AT_WIDTH(load)(NP, plan->p, plan->p_rows ? batch : 0, row, count, w->p);
    AT_WIDTH(load)(NX, c->mean, batch, row, count, w->mean);
    AT_WIDTH(load)(NX * NX, c->P, batch, row, count, w->first.L);
    for (int64_t k = 0; k <= last; k++) {
        AT_WIDTH(load_sample)(c, k, row, count, &w->at[k].at);
        if (k < last || k == 0)
            AT_WIDTH(load)(NX, c->start + k * NX * batch, batch, row, count, w->at[k].r);
    }
    if (last == 0) return;
    AT_WIDTH(set_interval)(c, last, &w->at[last - 1].at, &w->at[last].at, &over);
    memcpy(w->at[last].r, w->at[last - 1].r, sizeof w->at[last].r);
    AT_WIDTH(move)(&over, w->at[last].r);
}

/* Linearise the outputs, and the model up to the next sample, about the state at a sample. */
static inline void AT_WIDTH(linearise)(const struct window *c, int64_t k, const lanes *restrict p,
                                       struct linear *restrict now,
                                       const struct linear *restrict next, lanes *restrict end)
{
    AT_WIDTH(observe)(c->plan, p, now->r, &now->at, now->H);
    AT_WIDTH(whiten)(&now->at, now->e, now->H);
    if (next) AT_WIDTH(flow)(c, k, p, now, &next->at, end);
}

/* Take the first sample out of the window: it goes into the prior of the second state. */
SEPARATE void AT_WIDTH(shorten)(const struct window *c, struct moving *restrict w)
{
    lanes end[NX];
    AT_WIDTH(state_residual)(c->plan, w->mean, w->at[0].r, w->first.x);
    AT_WIDTH(linearise)(c, 0, w->p, &w->at[0], &w->at[1], end);
    AT_WIDTH(advance)(&w->at[0], &w->first);
    for (int i = 0; i < NX; i++) EACH_LANE w->mean[i][l] = end[i][l] + w->first.x[i][l];
}

/* Take a Gauss-Newton step of all states from the sample ``begin`` on. The last one has the covariance
   P, and ``before`` without its own sample. */
SEPARATE void AT_WIDTH(improve)(const struct window *c, int64_t begin, struct moving *restrict w,
                                lanes *restrict P, lanes *restrict before, int64_t *restrict bad)
{
    const int64_t last = c->samples - 1;
    struct linear *const at = w->at;
    struct earlier known = w->first;
    AT_WIDTH(state_residual)(c->plan, w->mean, at[begin].r, known.x);
    for (int64_t k = begin; k <= last; k++) {
        lanes end[NX];
        AT_WIDTH(linearise)(c, k, w->p, &at[k], k < last ? &at[k + 1] : NULL, end);
        if (k < last) AT_WIDTH(state_residual)(c->plan, end, at[k + 1].r, at[k].d);
    }
    for (int64_t k = last; k >= begin; k--)
        AT_WIDTH(look_ahead)(&at[k], k < last ? &at[k + 1] : NULL);
    for (int64_t k = begin; k <= last; k++) {
        lanes x[NX];
        AT_WIDTH(combine)(&at[k], &known, x, k < last ? NULL : P);
        if (k < last) {
            AT_WIDTH(advance)(&at[k], &known);
            for (int i = 0; i < NX; i++) EACH_LANE known.x[i][l] += at[k].d[i][l];
        }
        memcpy(at[k].r, x, sizeof x);
        AT_WIDTH(mark_outside)(c->plan, x, bad);
        for (int i = 0; i < NX; i++) EACH_LANE bad[l] |= !isfinite(x[i][l]);
    }
    AT_WIDTH(symmetric)(NX, NX, known.L, known.L, before);
}

/* Take the last sample of the call into W rows' windows, of which ``count`` exist. */
static void AT_WIDTH(window_rows)(const struct window *c, int64_t row, int count)
{
    const int64_t batch = c->batch, n = c->samples, begin = n > c->most;
    struct moving w = {.at = malloc((size_t)n * sizeof *w.at)};
    struct sample now;
    lanes H[NY * NX], HP[NY * NX], P[NX * NX], before[NX * NX];
    int64_t bad[W];
    EACH_LANE bad[l] = !w.at;
    if (w.at) {
        AT_WIDTH(load_window)(c, row, count, &w);
        now = w.at[n - 1].at;
        AT_WIDTH(observe)(c->plan, w.p, w.at[n - 1].r, &now, H);
        if (begin) AT_WIDTH(shorten)(c, &w);
        AT_WIDTH(improve)(c, begin, &w, P, before, bad);
        AT_WIDTH(output_moments)(H, before, now.R, HP, now.S);
        for (int64_t round = 1; round < c->rounds; round++)
            AT_WIDTH(improve)(c, begin, &w, P, before, bad);
        for (int64_t k = begin; k < n; k++)
            AT_WIDTH(store)(NX, w.at[k].r, c->start_after + (k - begin) * NX * batch, batch, row,
                            count);
        AT_WIDTH(store)(NX, w.at[n - 1].r, c->x, batch, row, count);
        AT_WIDTH(store)(NX * NX, P, c->P_x, batch, row, count);
        AT_WIDTH(store)(NX, w.mean, c->mean_after, batch, row, count);
        AT_WIDTH(store)(NX * NX, w.first.L, c->P_after, batch, row, count);
        AT_WIDTH(store)(NY, now.e, c->innovation, batch, row, count);
        AT_WIDTH(store)(NY * NY, now.S, c->S, batch, row, count);
        /* NumPy says where values that are not finite go. */
        for (int i = 0; i < NX * NX; i++)
            EACH_LANE bad[l] |= !isfinite(P[i][l]) | !isfinite(w.first.L[i][l]);
        for (int i = 0; i < NX; i++) EACH_LANE bad[l] |= !isfinite(w.mean[i][l]);
        free(w.at);
    }
    for (int l = 0; l < count; l++) c->left[row + l] |= bad[l] != 0;
}
