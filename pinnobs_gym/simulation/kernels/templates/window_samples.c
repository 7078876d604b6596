/* The samples of moving windows, and what they say of a state. */

/* a - b for states, of which those that repeat are within half a period */
static inline void AT_WIDTH(state_residual)(const struct plan *plan, const lanes *restrict a,
                                            const lanes *restrict b, lanes *restrict difference)
{
    for (int i = 0; i < NX; i++) {
        EACH_LANE difference[i][l] = a[i][l] - b[i][l];
        if (plan->state_period && plan->state_period[i])
            EACH_LANE difference[i][l] = wrapped(difference[i][l], plan->state_period[i]);
    }
}

/* Set the interval between two samples. */
static inline void AT_WIDTH(set_interval)(const struct window *c, int64_t k,
                                          const struct sample *before, const struct sample *now,
                                          struct interval *over)
{
    over->t0 = c->t[k - 1];
    over->t1 = c->t[k];
    memcpy(over->u0, before->u, sizeof over->u0);
    memcpy(over->u1, now->u, sizeof over->u1);
}

static inline void AT_WIDTH(load_sample)(const struct window *c, int64_t k, int64_t row, int count,
                                         struct sample *s)
{
    const struct plan *plan = c->plan;
    const int64_t own = plan->R_rows ? c->batch : 0;
    EACH_LANE s->t[l] = c->t[k];
    AT_WIDTH(load)(NY, c->y + k * NY * c->batch, c->batch, row, count, s->y);
    AT_WIDTH(load)(NU, c->u + k * NU * c->batch, c->batch, row, count, s->u);
    AT_WIDTH(load)(NY * NY, plan->R + k * plan->R_samples * NY * NY * (own ? own : 1), own, row,
                   count, s->R);
    AT_WIDTH(leave_out_missing)(s->y, s->R);
}
