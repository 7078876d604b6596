/* What the high-gain observer adds to the extended Kalman filter, as high_gain.py says: P grows by
   forgetting. ``carried`` is the size beyond which it does not grow, the size after the last sample
   with an output, the time of that sample, and if the plan has process noise, 1 where its part of P
   is known, which is not forgotten, and that part. */
#ifndef LARGEST
#define LARGEST 0
#define SIZE 1
#define LAST 2
#define KNOWN 3
#define ADDED 4
#endif

/* The logarithm of the factor by which P has grown at a time since the last sample with an output */
static inline double AT_WIDTH(growth)(const struct plan *plan, const struct memory *restrict own,
                                      seconds t, int l)
{
    const double allowed = log(own->carried[LARGEST][l] / own->carried[SIZE][l]);
    return minimum(plan->theta * (t - own->carried[LAST][l]), maximum(allowed, 0.0));
}

/* Enlarge P before it is predicted, but for the part of process noise, which is predicted here. */
SEPARATE void AT_WIDTH(forget)(const struct interval *over, const lanes *restrict x,
                               lanes *restrict P, struct memory *restrict own)
{
    const struct plan *plan = over->plan;
    lanes *const added = own->carried + ADDED, *const known = own->carried + KNOWN;
    const int noisy = plan->carried > ADDED;
    lanes factor;
    EACH_LANE factor[l] = exp(AT_WIDTH(growth)(plan, own, over->t1, l)
                              - AT_WIDTH(growth)(plan, own, over->t0, l));
    for (int i = 0; i < NX * NX; i++)
        EACH_LANE {
            const double kept = noisy && known[0][l] ? added[i][l] : 0;
            P[i][l] = (P[i][l] - kept) * factor[l] + kept;
        }
    if (!noisy) return;
    lanes along[NX];
    memcpy(along, x, sizeof along);
    AT_WIDTH(move_moments)(over, along, added, NULL);
    for (int i = 0; i < NX * NX; i++) EACH_LANE added[i][l] = known[0][l] ? added[i][l] : 0;
}

/* Find the size of P after a sample with an output, which is the first one in any case. */
static inline void AT_WIDTH(note_size)(const struct plan *plan, const struct sample *restrict s,
                                       const lanes *restrict P, struct memory *restrict own)
{
    lanes seen, size;
    EACH_LANE seen[l] = 0, size[l] = 0;
    for (int i = 0; i < NY; i++) EACH_LANE seen[l] = s->y[i][l] == s->y[i][l] ? 1 : seen[l];
    for (int i = 0; i < NX; i++) EACH_LANE size[l] += P[i * NX + i][l] * plan->per_scale[i];
    EACH_LANE seen[l] = own->carried[LAST][l] != own->carried[LAST][l] ? 1 : seen[l];
    EACH_LANE own->carried[SIZE][l] = seen[l] != 0 ? size[l] : own->carried[SIZE][l];
    EACH_LANE own->carried[LAST][l] = seen[l] != 0 ? s->t[l] : own->carried[LAST][l];
    for (int64_t i = ADDED; i < plan->carried; i++)
        EACH_LANE own->carried[i][l] = seen[l] != 0 ? 0 : own->carried[i][l];
}
