/* Observers without a covariance: that of luenberger.py and, with a switching term, of
   sliding_mode.py; without a gain the model alone. ``carried`` is the time of each output's last
   sample, NaN before the first. */

/* The prediction: x moves by the model. */
static inline void AT_WIDTH(predict)(const struct interval *over, lanes *restrict x,
                                     lanes *restrict P, int64_t *restrict bad)
{
    (void)P, (void)bad;
    AT_WIDTH(move)(over, x);
}

/* Find the length w of the step of each output: the time since its last sample, zero if it is
   missing. */
static inline void AT_WIDTH(time_since)(const struct sample *restrict s, lanes *restrict last,
                                        lanes *restrict w)
{
    for (int j = 0; j < NY; j++)
        EACH_LANE {
            const int missing = s->y[j][l] != s->y[j][l], first = last[j][l] != last[j][l];
            w[j][l] = missing || first ? 0 : s->t[l] - last[j][l];
            last[j][l] = missing && !first ? last[j][l] : s->t[l];
        }
}

/* Correct x by one linearised step of Euler's implicit method for x' = L (y - h(t, x, u)): by K e
   with K = L w (I + H L w)^-1. A switching term enlarges w by its secant, 1 + switching within the
   layer. Lanes that NumPy has to correct are marked in ``bad``. */
SEPARATE void AT_WIDTH(correct)(const struct plan *plan, const lanes *restrict p,
                                struct sample *restrict s, lanes *restrict x, lanes *restrict P,
                                struct memory *restrict memory, int64_t *restrict bad)
{
    lanes H[NY * NX], K[NX * NY], M[NY * NY], w[NY], rest;
    (void)P;
    if (!memory->gain) {
        AT_WIDTH(mark_outside)(plan, x, bad);
        return;
    }
    AT_WIDTH(time_since)(s, memory->carried, w);
    AT_WIDTH(plant_h_linearised)(s->t, x, s->u, p, s->e, H);
    for (int j = 0; j < NY; j++) {
        EACH_LANE s->e[j][l] = s->y[j][l] - s->e[j][l];
        if (plan->output_period && plan->output_period[j])
            EACH_LANE s->e[j][l] = wrapped(s->e[j][l], plan->output_period[j]);
        EACH_LANE s->e[j][l] = s->y[j][l] != s->y[j][l] ? 0 : s->e[j][l];
        if (plan->switching)
            EACH_LANE w[j][l] *= 1 + plan->switching / maximum(fabs(s->e[j][l])
                                     / (plan->layer * sqrt(s->R[j * NY + j][l])), 1.0);
        for (int i = 0; i < NX; i++) EACH_LANE K[i * NY + j][l] = memory->gain[i * NY + j] * w[j][l];
    }
    AT_WIDTH(product)(NY, NX, NY, H, K, M);
    for (int j = 0; j < NY; j++) EACH_LANE M[j * NY + j][l] += 1;
    EACH_LANE {
        double A[NX * NY], B[NY * NY];
        for (int i = 0; i < NX * NY; i++) A[i] = K[i][l];
        for (int i = 0; i < NY * NY; i++) B[i] = M[i][l];
        right_divide(NX, NY, A, B);
        for (int i = 0; i < NX * NY; i++) K[i][l] = A[i];
    }
    EACH_LANE rest[l] = 0;
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NY; j++) EACH_LANE x[i][l] += K[i * NY + j][l] * s->e[j][l];
        EACH_LANE rest[l] += x[i][l];
    }
    EACH_LANE bad[l] |= (rest[l] - rest[l] != 0) & !memory->lost[l];
    AT_WIDTH(mark_outside)(plan, x, bad);
}
