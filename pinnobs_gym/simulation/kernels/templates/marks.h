/* What compiled filters leave to NumPy; exported ones define these functions otherwise. */

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
