/* A moving window whose states are all unknown, as pinnobs_gym/estimation/moving_window.py says, by
   the two filters in roots of linear_window.py. Lanes that are left to NumPy are marked in
   ``bad``. */
#include <stdlib.h>

/* The model linearised about the state r at a sample: outputs e = H (x - r) + v, and x' = r' + d +
   F (x - r) + G w at the next sample, with v and w standard normal. Of the state, this sample and
   those after it say |A (x - r) - b|^2. */
#define linear AT_WIDTH(linear)
struct linear {
    struct sample at;
    lanes r[NX], d[NX], F[NX * NX], G[NX * NX], e[NY], H[NY * NX], A[NX * NX], b[NX];
};

/* What the samples before one say of its state: the mean less r, and a root of the covariance. */
#define earlier AT_WIDTH(earlier)
struct earlier {
    lanes x[NX], L[NX * NX];
};

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

/* Divide output errors and Jacobians by a root of R. */
static inline void AT_WIDTH(whiten)(const struct sample *restrict s, lanes *restrict e,
                                    lanes *restrict H)
{
    lanes T[NY * NY];
    AT_WIDTH(noise_root)(NY, s->R, T);
    for (int i = 0; i < NY; i++) EACH_LANE e[i][l] = s->e[i][l];
    AT_WIDTH(substitute)(NY, 1, T, NY, e);
    AT_WIDTH(substitute)(NY, NX, T, NY, H);
}

/* Move a state to the next sample, with the Jacobian F of the step and a root G of the noise. */
static inline void AT_WIDTH(flow)(const struct window *c, int64_t k, const lanes *restrict p,
                                  struct linear *restrict now, const struct sample *restrict next,
                                  lanes *restrict end)
{
    struct interval over = {.plan = c->plan, .p = p};
    lanes Q[NX * NX];
    AT_WIDTH(set_interval)(c, k + 1, &now->at, next, &over);
    for (int i = 0; i < NX * NX; i++) EACH_LANE now->F[i][l] = i % (NX + 1) == 0, Q[i][l] = 0;
    memcpy(end, now->r, sizeof now->r);
    AT_WIDTH(move_moments)(&over, end, Q, now->F);
    AT_WIDTH(noise_root)(NX, Q, now->G);
}

/* Take a sample into what is known of its state, and predict the next one less d. */
SEPARATE void AT_WIDTH(advance)(const struct linear *restrict now, struct earlier *restrict known)
{
    enum { n = NY + 2 * NX, m = NY + NX };
    lanes T[n * m], HL[NY * NX], FL[NX * NX], e[NY], moved[NX];
    /* QR of [[I, H L, 0], [0, F L, G]]^T is [[S^1/2, 0], [F K S^1/2, L']]^T. */
    AT_WIDTH(product)(NY, NX, NX, now->H, known->L, HL);
    AT_WIDTH(product)(NX, NX, NX, now->F, known->L, FL);
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < m; j++) EACH_LANE T[i * m + j][l] = i == j;
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NY; j++) {
            EACH_LANE T[(NY + i) * m + j][l] = HL[j * NX + i][l];
            EACH_LANE T[(NY + NX + i) * m + j][l] = 0;
        }
        for (int j = 0; j < NX; j++) {
            EACH_LANE T[(NY + i) * m + NY + j][l] = FL[j * NX + i][l];
            EACH_LANE T[(NY + NX + i) * m + NY + j][l] = now->G[j * NX + i][l];
        }
    }
    AT_WIDTH(triangle)(n, m, T);
    AT_WIDTH(product)(NY, NX, 1, now->H, known->x, e);
    for (int i = 0; i < NY; i++) EACH_LANE e[i][l] = now->e[i][l] - e[i][l];
    for (int i = 0; i < NY; i++) { /* by the root of S, which is transposed in T */
        for (int q = 0; q < i; q++) EACH_LANE e[i][l] -= T[q * m + i][l] * e[q][l];
        EACH_LANE e[i][l] = T[i * m + i][l] == 0 ? 0 : e[i][l] / T[i * m + i][l];
    }
    AT_WIDTH(product)(NX, NX, 1, now->F, known->x, moved);
    for (int i = 0; i < NX; i++) {
        for (int q = 0; q < NY; q++) EACH_LANE moved[i][l] += T[q * m + NY + i][l] * e[q][l];
        EACH_LANE known->x[i][l] = moved[i][l];
        for (int j = 0; j < NX; j++)
            EACH_LANE known->L[i * NX + j][l] = j > i ? 0 : T[(NY + j) * m + NY + i][l];
    }
}

/* Find what a sample and those after it say of its state; ``ahead`` is the next one, or NULL. */
SEPARATE void AT_WIDTH(look_ahead)(struct linear *restrict now, const struct linear *restrict ahead)
{
    enum { n = 2 * NX + NY, m = 2 * NX + 1 };
    lanes T[n * m], AG[NX * NX], AF[NX * NX], Ad[NX];
    for (int i = 0; i < n * m; i++) EACH_LANE T[i][l] = 0;
    if (ahead) { /* the next state is d + F (x - r) + G w, and w is standard normal */
        AT_WIDTH(product)(NX, NX, NX, ahead->A, now->G, AG);
        AT_WIDTH(product)(NX, NX, NX, ahead->A, now->F, AF);
        AT_WIDTH(product)(NX, NX, 1, ahead->A, now->d, Ad);
        for (int i = 0; i < NX; i++) {
            EACH_LANE T[i * m + i][l] = 1;
            for (int j = 0; j < NX; j++) {
                EACH_LANE T[(NX + i) * m + j][l] = AG[i * NX + j][l];
                EACH_LANE T[(NX + i) * m + NX + j][l] = AF[i * NX + j][l];
            }
            EACH_LANE T[(NX + i) * m + 2 * NX][l] = ahead->b[i][l] - Ad[i][l];
        }
    }
    for (int i = 0; i < NY; i++) {
        for (int j = 0; j < NX; j++) EACH_LANE T[(2 * NX + i) * m + NX + j][l] = now->H[i * NX + j][l];
        EACH_LANE T[(2 * NX + i) * m + 2 * NX][l] = now->e[i][l];
    }
    AT_WIDTH(triangle)(n, m, T);
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++)
            EACH_LANE now->A[i * NX + j][l] = j < i ? 0 : T[(NX + i) * m + NX + j][l];
        EACH_LANE now->b[i][l] = T[(NX + i) * m + 2 * NX][l];
    }
}

/* Find a state from what is known before, x = r + before + L z with z standard normal, and what the
   sample and those after it say. If P is given, it becomes the covariance. */
SEPARATE void AT_WIDTH(combine)(const struct linear *restrict now, const struct earlier *restrict known,
                                lanes *restrict x, lanes *restrict P)
{
    enum { n = 2 * NX, m = NX + 1 };
    lanes T[n * m], AL[NX * NX], Ax[NX], root[NX * NX];
    AT_WIDTH(product)(NX, NX, NX, now->A, known->L, AL);
    AT_WIDTH(product)(NX, NX, 1, now->A, known->x, Ax);
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < m; j++) EACH_LANE T[i * m + j][l] = i == j;
        for (int j = 0; j < NX; j++) EACH_LANE T[(NX + i) * m + j][l] = AL[i * NX + j][l];
        EACH_LANE T[(NX + i) * m + NX][l] = now->b[i][l] - Ax[i][l];
    }
    AT_WIDTH(triangle)(n, m, T);
    /* z = T_zz^-1 T_z, whose covariance has the root T_zz^-1 */
    for (int i = NX - 1; i >= 0; i--) {
        for (int q = i + 1; q < NX; q++)
            EACH_LANE T[i * m + NX][l] -= T[i * m + q][l] * T[q * m + NX][l];
        EACH_LANE T[i * m + NX][l] /= T[i * m + i][l];
    }
    for (int i = 0; i < NX; i++) {
        EACH_LANE x[i][l] = now->r[i][l] + known->x[i][l];
        for (int q = 0; q < NX; q++)
            EACH_LANE x[i][l] += known->L[i * NX + q][l] * T[q * m + NX][l];
    }
    if (!P) return;
    memcpy(root, known->L, sizeof root);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) { /* root = L T_zz^-1 */
            for (int q = 0; q < j; q++)
                EACH_LANE root[i * NX + j][l] -= root[i * NX + q][l] * T[q * m + j][l];
            EACH_LANE root[i * NX + j][l] /= T[j * m + j][l];
        }
    AT_WIDTH(symmetric)(NX, NX, root, root, P);
}

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
