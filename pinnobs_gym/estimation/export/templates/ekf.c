/* What the algorithm asks for beside the equations. Bounds and wide angles are dealt with below. */
static inline void mark_wide(const struct plan *plan, const real *P, const real *S, int64_t *bad)
{
    (void)plan, (void)P, (void)S, (void)bad;
}

static inline void mark_outside(const struct plan *plan, const real *x, int64_t *bad)
{
    (void)plan, (void)x, (void)bad;
}

#ifdef RESTARTS
/* Give the prediction the covariance with which the gate restarts the filter, after too many samples
   in a row beyond it. */
static inline void restart(const struct plan *plan, const real *H, const real *R, real *P, real *HP,
                           real *S, struct memory *memory)
{
    if (memory->carried[0] < plan->patience) return;
    memory->carried[0] = 0;
    memcpy(P, memory->P_restart, sizeof memory->P_restart);
    output_moments(H, P, R, HP, S);
}
#endif
