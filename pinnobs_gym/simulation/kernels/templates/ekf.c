/* The extended Kalman filter, as pinnobs_gym/estimators/ekf.py says. */

/* The prediction: x moves by the model, and P by its linearisation. */
static inline void AT_WIDTH(predict)(const struct interval *over, lanes *restrict x,
                                     lanes *restrict P, int64_t *restrict bad)
{
    (void)bad;
    AT_WIDTH(move_moments)(over, x, P, NULL);
}

/* Correct x and P by the outputs of a sample. Lanes that NumPy has to correct are marked in
   ``bad``. */
SEPARATE void AT_WIDTH(correct)(const struct plan *plan, const lanes *restrict p,
                                struct sample *restrict s, lanes *restrict x, lanes *restrict P,
                                struct memory *restrict memory, int64_t *restrict bad)
{
    lanes *const y = s->y, *const e = s->e, *const R = s->R, *const S = s->S;
    lanes H[NY * NX], HP[NY * NX];
    double rest[W];
    /* Innovation e = y - h and H; both are zero for missing outputs. */
    AT_WIDTH(plant_h_linearised)(s->t, x, s->u, p, e, H);
    for (int i = 0; i < NY; i++) {
        EACH_LANE e[i][l] = y[i][l] - e[i][l];
        if (plan->output_period && plan->output_period[i])
            EACH_LANE e[i][l] = wrapped(e[i][l], plan->output_period[i]);
        EACH_LANE e[i][l] = y[i][l] != y[i][l] ? 0 : e[i][l];
        for (int j = 0; j < NX; j++)
            EACH_LANE H[i * NX + j][l] = y[i][l] != y[i][l] ? 0 : H[i * NX + j][l];
    }
    AT_WIDTH(output_moments)(H, P, R, HP, S);
    AT_WIDTH(mark_wide)(plan, P, S, bad);
    if (plan->gate) { /* restart after too many samples in a row beyond it, of lanes in NumPy */
        lanes Se[NY];
        for (int i = 0; i < NY; i++) EACH_LANE Se[i][l] = e[i][l];
        AT_WIDTH(divide)(1, S, Se, bad);
        EACH_LANE {
            int present = 0;
            double nis = 0;
            for (int i = 0; i < NY; i++) {
                present += y[i][l] == y[i][l];
                nis += Se[i][l] * e[i][l];
            }
            if (present) memory->beyond[l] = nis <= plan->gate[present] ? 0 : memory->beyond[l] + 1;
#ifndef RESTARTS
            bad[l] |= memory->beyond[l] >= plan->patience;
#endif
        }
#ifdef RESTARTS
        AT_WIDTH(restart)(plan, H, R, P, HP, S, memory);
#endif
    }
    if (plan->huber) { /* enlarge variances of outputs with large innovations */
        lanes excess[NY];
        for (int i = 0; i < NY; i++)
            EACH_LANE excess[i][l] =
                maximum(fabs(e[i][l]) / (plan->huber * sqrt(S[i * NY + i][l])), 1.0);
        for (int i = 0; i < NY; i++)
            for (int j = 0; j < NY; j++)
                EACH_LANE {
                    const double more =
                        R[i * NY + j][l] * sqrt(excess[i][l] * excess[j][l]); /* as correlated */
                    S[i * NY + j][l] += more - R[i * NY + j][l];
                    R[i * NY + j][l] = more;
                }
    }
    AT_WIDTH(kalman_update)(H, HP, S, R, e, x, P, rest);
    EACH_LANE bad[l] |= (rest[l] != 0) & !memory->lost[l];
    AT_WIDTH(mark_outside)(plan, x, bad);
}
