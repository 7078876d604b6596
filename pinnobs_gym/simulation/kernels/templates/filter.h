/* What filters share: a sample, the rows of a call, and when a sample is left to NumPy. */

/* The arrays of a call, with the batch as the last axis. The row of a sample is (n, batch). */
#ifndef CALL
#define CALL
#define MOST_STEPS 100000 /* between two samples */

struct call {
    const struct plan *plan;
    int64_t batch, samples;
    const double *t;          /* (samples,) */
    const double *y;          /* (samples, NY, batch); NaN is missing */
    const double *u;          /* (samples, NU, batch) */
    double *x;                /* (samples, NX, batch) */
    double *P;                /* (samples, NX, NX, batch) */
    double *innovation;       /* (samples, NY, batch) */
    double *S;                /* (samples, NY, NY, batch) */
    const double *t_before;   /* time of the sample before, or NULL: x and P are then predictions */
    const double *u_before;   /* (NU, batch) */
    const double *x_before;   /* (NX, batch) */
    const double *P_before;   /* (NX, NX, batch) */
    /* EKF with a gate */
    int64_t *beyond;          /* (batch,) samples in a row beyond the gate */
    /* results of the forward pass of a smoother, or NULL; innovation and S are then NULL */
    double *x_predicted;      /* (samples, NX, batch) */
    double *P_predicted;      /* (samples, NX, NX, batch) */
    double *F;                /* (samples, NX, NX, batch) of the step to a sample */
    double *Q;                /* (samples, NX, NX, batch) of the same */
};
#endif

/* A sample of W rows: its time, outputs and inputs, the covariance of the outputs' noise, and the
   innovations with their covariances, which are found from these. */
#define sample AT_WIDTH(sample)
struct sample {
    lanes t, y[NY], u[LU], R[NY * NY], e[NY], S[NY * NY];
};

/* What is known of W rows beside x and P: the number of samples in a row beyond the gate, and
   whether x and P are NaN throughout. */
#define memory AT_WIDTH(memory)
struct memory {
    int64_t beyond[W], lost[W];
};

/* Load the covariance of the noise of a sample, without the covariances of missing outputs. */
static inline void AT_WIDTH(load_R)(const struct plan *plan, int64_t k, int64_t batch, int64_t row,
                                    int count, const lanes *restrict y, lanes *restrict R)
{
    const int64_t own = plan->R_rows ? batch : 0;
    const double *from = plan->R + k * plan->R_samples * NY * NY * (own ? own : 1);
    AT_WIDTH(load)(NY * NY, from, own, row, count, R);
    for (int i = 0; i < NY; i++) /* covariances with missing outputs do not count */
        for (int j = 0; j < NY; j++)
            if (i != j)
                EACH_LANE if (y[i][l] != y[i][l] || y[j][l] != y[j][l]) R[i * NY + j][l] = 0;
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

/* Find the rows whose state and covariance are NaN throughout. They remain so. Rows in which some
   values are not finite are left to NumPy, where the others become so in the order in which dense
   products carry them. */
static inline void AT_WIDTH(find_lost)(const lanes *restrict x, const lanes *restrict P,
                                       int64_t *restrict lost)
{
    EACH_LANE {
        lost[l] = 1;
        for (int i = 0; i < NX; i++) lost[l] &= x[i][l] != x[i][l];
        for (int i = 0; i < NX * NX; i++) lost[l] &= P[i][l] != P[i][l];
    }
}

/* Mark the lanes in which a state is outside of its bounds. */
static inline void AT_WIDTH(mark_outside)(const struct plan *plan, const lanes *restrict x,
                                          int64_t *restrict bad)
{
    if (plan->low)
        for (int i = 0; i < NX; i++)
            EACH_LANE bad[l] |= (x[i][l] < plan->low[i]) | (x[i][l] > plan->high[i]);
}

/* Mark the lanes in which an angle is so uncertain that whole turns count: the standard deviation of
   a state is above a twelfth of its period, or that of an output above a sixth. See
   pinnobs_gym/estimation/wrapping.py. */
static inline void AT_WIDTH(mark_wide)(const struct plan *plan, const lanes *restrict P,
                                       const lanes *restrict S, int64_t *restrict bad)
{
    for (int i = 0; plan->state_period && i < NX; i++) {
        const double widest = plan->state_period[i] / 12;
        if (widest) EACH_LANE bad[l] |= P[i * NX + i][l] > widest * widest;
    }
    for (int i = 0; plan->output_period && i < NY; i++) {
        const double widest = plan->output_period[i] / 6;
        if (widest) EACH_LANE bad[l] |= S[i * NY + i][l] > widest * widest;
    }
}

/* Note the number of the sample in the lanes that are bad for the first time, which NumPy has to
   go on with. Return whether all rows that exist are bad. The others go on, so that none depends
   on its neighbours. */
static inline int AT_WIDTH(note_bad)(const int64_t *restrict bad, int64_t k, int64_t samples,
                                     int64_t *restrict reached, int count)
{
    int all = 1;
    for (int l = 0; l < count; l++) {
        if (bad[l] && reached[l] == samples) reached[l] = k;
        all &= bad[l] != 0;
    }
    return all;
}


/* 1 if the model can be moved between these times here */
static inline int AT_WIDTH(movable)(const struct plan *plan, double t0, double t1)
{
    if (!(t1 > t0)) return 0;
    if (!((t1 - t0) / (plan->discrete ? 1 : plan->longest) < MOST_STEPS)) return 0;
    return !plan->discrete || (t0 == floor(t0) && t1 == floor(t1));
}
