/* The smoothing of a model that is linearised about the states of a window, by two filters in roots, as
   pinnobs_gym/estimation/linear_window.py says. */

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
