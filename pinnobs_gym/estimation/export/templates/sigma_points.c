/* Leave a sample out whose angles are so uncertain that whole turns count: the standard deviation of
   a state is above a twelfth of its period, or that of an output above a sixth. */
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

/* Plants with bounds are not exported with this filter. */
static inline void mark_outside(const struct plan *plan, const real *x, int64_t *bad)
{
    (void)plan, (void)x, (void)bad;
}
