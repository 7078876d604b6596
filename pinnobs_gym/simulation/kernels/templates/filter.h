/* What filters share: a sample, and when it is left to NumPy. */

#define MOST_STEPS 100000 /* between two samples */

/* A sample of W rows: its time, outputs and inputs, the covariance of the outputs' noise, and the
   innovations with their covariances, which are found from these. */
#define sample AT_WIDTH(sample)
struct sample {
    lanes t, y[NY], u[LU], R[NY * NY], e[NY], S[NY * NY];
};

/* What is known of W rows beside x and P: what the algorithm remembers from sample to sample, and
   whether x and P are NaN throughout. */
#ifndef CARRIED
#define CARRIED 1
#endif
#ifdef OBSERVER /* it has no covariances: the numbers of entries that are loaded and stored */
#define PP 0
#define SS 0
#else
#define PP (NX * NX)
#define SS (NY * NY)
#endif
#define memory AT_WIDTH(memory)
struct memory {
    lanes carried[CARRIED];
    const double *gain;
    int64_t lost[W];
#ifdef RESTARTS
    lanes P_restart[NX * NX]; /* covariances with which the gate restarts a filter */
#endif
};

/* Set the covariances of missing outputs with others to zero, so that these do not count. */
static inline void AT_WIDTH(leave_out_missing)(const lanes *restrict y, lanes *restrict R)
{
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++)
            if (i != j)
                EACH_LANE if (y[i][l] != y[i][l] || y[j][l] != y[j][l]) R[i * NY + j][l] = 0;
}

/* Find innovations and output Jacobians of a sample at x, zero for missing outputs. */
static inline void AT_WIDTH(observe)(const struct plan *plan, const lanes *restrict p,
                                     const lanes *restrict x, struct sample *restrict s,
                                     lanes *restrict H)
{
    AT_WIDTH(plant_h_linearised)(s->t, x, s->u, p, s->e, H);
    for (int i = 0; i < NY; i++) {
        EACH_LANE s->e[i][l] = s->y[i][l] - s->e[i][l];
        if (plan->output_period && plan->output_period[i])
            EACH_LANE s->e[i][l] = wrapped(s->e[i][l], plan->output_period[i]);
        EACH_LANE s->e[i][l] = s->y[i][l] != s->y[i][l] ? 0 : s->e[i][l];
        for (int j = 0; j < NX; j++)
            EACH_LANE H[i * NX + j][l] = s->y[i][l] != s->y[i][l] ? 0 : H[i * NX + j][l];
    }
}

/* Mark the lanes in which P (n, n) is finite and its factor L is not: it has none. */
static inline void AT_WIDTH(mark_without_root)(int n, const lanes *restrict P,
                                               const lanes *restrict L, int64_t *restrict bad)
{
    int64_t finite[W];
    EACH_LANE finite[l] = 1;
    for (int i = 0; i < n * n; i++) EACH_LANE finite[l] &= isfinite(P[i][l]) != 0;
    EACH_LANE bad[l] |= finite[l] & !isfinite(L[n * n - 1][l]);
}

/* X = X S^-1 for X (n, NY) and S (NY, NY) symmetric. Lanes where rounding leaves S no root are
   marked in ``bad``. */
static inline void AT_WIDTH(divide)(int n, const lanes *restrict S, lanes *restrict X,
                                    int64_t *restrict bad)
{
    if (NY == 1) {
        for (int i = 0; i < n; i++) EACH_LANE X[i][l] /= S[0][l];
        return;
    }
    lanes root[NY * NY];
    AT_WIDTH(cholesky)(NY, S, root);
    AT_WIDTH(divide_factored)(n, NY, X, root);
    AT_WIDTH(mark_without_root)(NY, S, root, bad);
}

/* 1 if the model can be moved between these times here */
static inline int AT_WIDTH(movable)(const struct plan *plan, seconds t0, seconds t1)
{
    if (!(t1 > t0)) return 0;
    if (!((t1 - t0) / (plan->discrete ? 1 : plan->longest) < MOST_STEPS)) return 0;
    return !plan->discrete || (t0 == floor(t0) && t1 == floor(t1));
}
