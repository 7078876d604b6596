/* A filter through the samples of a call: what is loaded, stored and left to NumPy. Its algorithm is
   the pair ``predict`` and ``correct`` of another template. */

/* The arrays of a call, with the batch as the last axis. The row of a sample is (n, batch). */
#ifndef CALL
#define CALL
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
    double *carried;          /* (plan->carried, batch) what an algorithm remembers, or NULL */
    const double *gain;       /* (NX, NY) of an observer, or NULL */
    /* results of the forward pass of a smoother, or NULL; innovation and S are then NULL */
    double *x_predicted;      /* (samples, NX, batch) */
    double *P_predicted;      /* (samples, NX, NX, batch) */
    double *F;                /* (samples, NX, NX, batch) of the step to a sample */
    double *Q;                /* (samples, NX, NX, batch) of the same */
};
#endif

/* Load the covariance of the noise of a sample. */
static inline void AT_WIDTH(load_R)(const struct plan *plan, int64_t k, int64_t batch, int64_t row,
                                    int count, const lanes *restrict y, lanes *restrict R)
{
    const int64_t own = plan->R_rows ? batch : 0;
    const double *from = plan->R + k * plan->R_samples * NY * NY * (own ? own : 1);
    AT_WIDTH(load)(NY * NY, from, own, row, count, R);
    AT_WIDTH(leave_out_missing)(y, R);
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
        for (int i = 0; i < PP; i++) lost[l] &= P[i][l] != P[i][l];
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

#ifdef SMOOTHED
/* Predict sample k by the Jacobian F of the model's step and the process noise Q over it, which a
   smoother needs: P = F P F^T + Q. */
SEPARATE void AT_WIDTH(predict_apart)(const struct call *c, const struct interval *over, int64_t k,
                                      int64_t row, int count, lanes *restrict x,
                                      lanes *restrict P)
{
    const int64_t place = k * NX * NX * c->batch;
    lanes F[NX * NX], Q[NX * NX];
    for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] = i % (NX + 1) == 0, Q[i][l] = 0;
    AT_WIDTH(move_moments)(over, x, Q, F);
    AT_WIDTH(sandwich)(NX, F, P);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += Q[i][l];
    AT_WIDTH(store)(NX * NX, F, c->F + place, c->batch, row, count);
    AT_WIDTH(store)(NX * NX, Q, c->Q + place, c->batch, row, count);
}
#endif

static inline void AT_WIDTH(load_sample)(const struct call *c, int64_t k, int64_t row, int count,
                                         struct sample *s)
{
    EACH_LANE s->t[l] = c->t[k];
    AT_WIDTH(load)(NY, c->y + k * NY * c->batch, c->batch, row, count, s->y);
    AT_WIDTH(load)(NU, c->u + k * NU * c->batch, c->batch, row, count, s->u);
    AT_WIDTH(load_R)(c->plan, k, c->batch, row, count, s->y, s->R);
}

/* Filter W rows, of which ``count`` exist. ``reached`` is set to the number of the sample that NumPy
   has to do in each, or the number of samples. */
SEPARATE void AT_WIDTH(filter_rows)(const struct call *c, int64_t row, int count,
                                    int64_t *restrict reached)
{
    const struct plan *plan = c->plan;
    const int64_t batch = c->batch;
    lanes p[LP], x[NX], P[NX * NX];
    struct interval over = {.plan = plan, .p = p};
    struct sample now;
    struct memory own;
    int64_t bad[W];
    EACH_LANE bad[l] = 0;
    for (int l = 0; l < count; l++) reached[l] = c->samples;
    own.gain = c->gain;
    AT_WIDTH(load)(plan->carried, c->carried, batch, row, count, own.carried);
    AT_WIDTH(load)(NP, plan->p, plan->p_rows ? batch : 0, row, count, p);
    AT_WIDTH(load)(NX, c->x_before, batch, row, count, x);
    AT_WIDTH(load)(PP, c->P_before, batch, row, count, P);
    AT_WIDTH(find_lost)(x, P, own.lost);
    if (c->t_before) AT_WIDTH(load)(NU, c->u_before, batch, row, count, over.u1);
    for (int64_t k = 0; k < c->samples; k++) {
        const double *before = k ? c->t + k - 1 : c->t_before;
        if (before) {
            if (!AT_WIDTH(movable)(plan, *before, c->t[k])) EACH_LANE bad[l] = 1;
            if (AT_WIDTH(note_bad)(bad, k, c->samples, reached, count)) return;
            over.t0 = *before;
            over.t1 = c->t[k];
            memcpy(over.u0, over.u1, sizeof over.u0);
        }
        AT_WIDTH(load_sample)(c, k, row, count, &now);
        memcpy(over.u1, now.u, sizeof over.u1);
#ifdef SMOOTHED
        if (before) AT_WIDTH(predict_apart)(c, &over, k, row, count, x, P);
        AT_WIDTH(store)(NX, x, c->x_predicted + k * NX * batch, batch, row, count);
        AT_WIDTH(store)(NX * NX, P, c->P_predicted + k * NX * NX * batch, batch, row, count);
#else
#ifdef FORGETTING
        if (before) AT_WIDTH(forget)(&over, x, P, &own);
#endif
        if (before) AT_WIDTH(predict)(&over, x, P, bad);
#endif
        AT_WIDTH(correct)(plan, p, &now, x, P, &own, bad);
#ifdef FORGETTING
        AT_WIDTH(note_size)(plan, &now, P, &own);
#endif
#ifndef SMOOTHED
        if (c->innovation)
            AT_WIDTH(store)(NY, now.e, c->innovation + k * NY * batch, batch, row, count);
        AT_WIDTH(store)(SS, now.S, c->S + k * SS * batch, batch, row, count);
#endif
        if (AT_WIDTH(note_bad)(bad, k, c->samples, reached, count)) return;
        AT_WIDTH(store)(NX, x, c->x + k * NX * batch, batch, row, count);
        AT_WIDTH(store)(PP, P, c->P + k * PP * batch, batch, row, count);
        for (int i = 0; i < plan->carried; i++)
            for (int l = 0; l < count; l++)
                if (!bad[l]) c->carried[i * batch + row + l] = own.carried[i][l];
    }
}
