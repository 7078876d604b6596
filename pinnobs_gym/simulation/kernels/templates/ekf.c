/* The extended Kalman filter, as pinnobs_gym/estimators/ekf.py says. */

/* Correct x and P by the outputs of sample k. Lanes that NumPy has to correct are marked in
   ``bad``. */
SEPARATE void AT_WIDTH(correct)(const struct call *c, const lanes *restrict p, int64_t k,
                                    int64_t row, int count, lanes *restrict x, lanes *restrict P,
                                    const int64_t *restrict lost, int64_t *restrict beyond,
                                    int64_t *restrict bad)
{
    const struct plan *plan = c->plan;
    lanes t, y[NY], u[LU], e[NY], H[NY * NX], R[NY * NY], S[NY * NY], HP[NY * NX];
    double rest[W];
    EACH_LANE t[l] = c->t[k];
    AT_WIDTH(load)(NY, c->y + k * NY * c->batch, c->batch, row, count, y);
    AT_WIDTH(load)(NU, c->u + k * NU * c->batch, c->batch, row, count, u);
    AT_WIDTH(load_R)(plan, k, c->batch, row, count, y, R);
    /* Innovation e = y - h and H; both are zero for missing outputs. */
    AT_WIDTH(plant_h_linearised)(t, x, u, p, e, H);
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
    if (plan->gate) { /* rows that were beyond the gate for long are restarted in NumPy */
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
            if (present) beyond[l] = nis <= plan->gate[present] ? 0 : beyond[l] + 1;
            bad[l] |= beyond[l] >= plan->patience;
        }
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
    if (c->S) {
        AT_WIDTH(store)(NY, e, c->innovation + k * NY * c->batch, c->batch, row, count);
        AT_WIDTH(store)(NY * NY, S, c->S + k * NY * NY * c->batch, c->batch, row, count);
    }
    EACH_LANE bad[l] |= (rest[l] != 0) & !lost[l];
    AT_WIDTH(mark_outside)(plan, x, bad);
}

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

/* Filter W rows, of which ``count`` exist. ``reached`` is set to the number of the sample that NumPy
   has to do in each, or the number of samples. */
SEPARATE void AT_WIDTH(filter_rows)(const struct call *c, int64_t row, int count,
                                  int64_t *restrict reached)
{
    const struct plan *plan = c->plan;
    lanes p[LP], x[NX], P[NX * NX];
    struct interval over = {.plan = plan, .p = p};
    int64_t beyond[W], bad[W], lost[W];
    EACH_LANE bad[l] = 0;
    for (int l = 0; l < count; l++) reached[l] = c->samples;
    EACH_LANE beyond[l] = plan->gate ? c->beyond[row + MIN(l, count - 1)] : 0;
    AT_WIDTH(load)(NP, plan->p, plan->p_rows ? c->batch : 0, row, count, p);
    AT_WIDTH(load)(NX, c->x_before, c->batch, row, count, x);
    AT_WIDTH(load)(NX * NX, c->P_before, c->batch, row, count, P);
    AT_WIDTH(find_lost)(x, P, lost);
    if (c->t_before) AT_WIDTH(load)(NU, c->u_before, c->batch, row, count, over.u1);
    for (int64_t k = 0; k < c->samples; k++) {
        const double *before = k ? c->t + k - 1 : c->t_before;
        if (before) {
            if (!AT_WIDTH(movable)(plan, *before, c->t[k])) EACH_LANE bad[l] = 1;
            if (AT_WIDTH(note_bad)(bad, k, c->samples, reached, count)) return;
            over.t0 = *before;
            over.t1 = c->t[k];
            memcpy(over.u0, over.u1, sizeof over.u0);
        }
        AT_WIDTH(load)(NU, c->u + k * NU * c->batch, c->batch, row, count, over.u1);
        if (before && c->F) AT_WIDTH(predict_apart)(c, &over, k, row, count, x, P);
        else if (before) AT_WIDTH(move_moments)(&over, x, P, NULL);
        if (c->x_predicted) {
            AT_WIDTH(store)(NX, x, c->x_predicted + k * NX * c->batch, c->batch, row, count);
            AT_WIDTH(store)(NX * NX, P, c->P_predicted + k * NX * NX * c->batch, c->batch, row,
                            count);
        }
        AT_WIDTH(correct)(c, p, k, row, count, x, P, lost, beyond, bad);
        if (AT_WIDTH(note_bad)(bad, k, c->samples, reached, count)) return;
        AT_WIDTH(store)(NX, x, c->x + k * NX * c->batch, c->batch, row, count);
        AT_WIDTH(store)(NX * NX, P, c->P + k * NX * NX * c->batch, c->batch, row, count);
        if (plan->gate)
            for (int l = 0; l < count; l++)
                if (!bad[l]) c->beyond[row + l] = beyond[l];
    }
}
