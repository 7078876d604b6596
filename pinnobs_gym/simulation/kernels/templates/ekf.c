/* The extended Kalman filter, as pinnobs_gym/estimators/ekf.py says, and the strong-tracking one of
   strong_tracking_ekf.py. ``carried`` of the one is the number of samples in a row beyond the gate,
   that of the other the size e^T R^-1 e / NY of the last innovation. */

/* The prediction: x moves by the model, and P by its linearisation. */
static inline void AT_WIDTH(predict)(const struct interval *over, lanes *restrict x,
                                     lanes *restrict P, int64_t *restrict bad)
{
    (void)bad;
    AT_WIDTH(move_moments)(over, x, P, NULL);
}

/* Add to P what the last innovation makes it grow by, at samples with any output. */
static inline void AT_WIDTH(grow)(const struct plan *plan, const lanes *restrict y,
                                  const lanes *restrict size, lanes *restrict P)
{
    lanes seen;
    EACH_LANE seen[l] = 0;
    for (int i = 0; i < NY; i++) EACH_LANE seen[l] = y[i][l] == y[i][l] ? 1 : seen[l];
    for (int i = 0; i < NX; i++)
        EACH_LANE P[i * NX + i][l] += plan->growth[i] * (seen[l] != 0 ? size[0][l] : 0);
}

/* Find the size of an innovation; a sample without any output leaves that of the last one. */
static inline void AT_WIDTH(remember)(const struct sample *restrict s, lanes *restrict size,
                                      int64_t *restrict bad)
{
    lanes Re[NY], sum, seen;
    EACH_LANE sum[l] = seen[l] = 0;
    for (int i = 0; i < NY; i++) EACH_LANE Re[i][l] = s->e[i][l];
    AT_WIDTH(divide)(1, s->R, Re, bad);
    for (int i = 0; i < NY; i++)
        EACH_LANE {
            sum[l] += Re[i][l] * s->e[i][l];
            seen[l] = s->y[i][l] == s->y[i][l] ? 1 : seen[l];
        }
    EACH_LANE size[0][l] = seen[l] != 0 ? sum[l] / NY : size[0][l];
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
    if (plan->growth) AT_WIDTH(grow)(plan, y, memory->carried, P);
    AT_WIDTH(observe)(plan, p, x, s, H);
    AT_WIDTH(output_moments)(H, P, R, HP, S);
#ifndef FORGETTING /* such an observer has nothing to say of angles */
    AT_WIDTH(mark_wide)(plan, P, S, bad);
#endif
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
            if (present)
                memory->carried[0][l] = nis <= plan->gate[present] ? 0 : memory->carried[0][l] + 1;
#ifndef RESTARTS
            bad[l] |= memory->carried[0][l] >= plan->patience;
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
    if (plan->growth) AT_WIDTH(remember)(s, memory->carried, bad);
    if (plan->caution) { /* R = R + caution H P H^T */
        lanes HPH[NY * NY];
        AT_WIDTH(symmetric)(NY, NX, HP, H, HPH);
        for (int i = 0; i < NY * NY; i++)
            EACH_LANE {
                R[i][l] += plan->caution * HPH[i][l];
                S[i][l] += plan->caution * HPH[i][l];
            }
    }
    AT_WIDTH(kalman_update)(H, HP, S, R, e, x, P, rest);
    EACH_LANE bad[l] |= (rest[l] != 0) & !memory->lost[l];
    AT_WIDTH(mark_outside)(plan, x, bad);
}
