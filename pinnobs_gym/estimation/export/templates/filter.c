void @name@_init(@name@ *filter, const @real@ *xhat0, const @real@ *P0)
{
    memset(filter, 0, sizeof *filter);
    memcpy(filter->x, xhat0 ? xhat0 : prior_mean, sizeof filter->x);
    memcpy(filter->P, P0 ? P0 : prior_cov, sizeof filter->P);
    @restart@after_prediction(&plan, filter->P);
}

/* Predict the sample from the one before, and correct. Return 0 if that fails. */
static int advance(@name@ *filter, struct sample *now, seconds t)
{
    struct memory memory;
    int64_t bad[1] = {0};
    memset(&memory, 0, sizeof memory);
    @before@memcpy(now->R, output_noise, sizeof now->R);
    leave_out_missing(now->y, now->R);
    if (filter->samples) {
        const struct interval over = interval_to(filter, now, t);
        predict(&over, filter->x, filter->P, bad);
        after_prediction(&plan, filter->P);
    }
    correct(&plan, plan.p, now, filter->x, filter->P, &memory, bad);
    after_correction(&plan, filter->x, filter->P);
    memcpy(filter->innovation, now->e, sizeof filter->innovation);
    memcpy(filter->S, now->S, sizeof filter->S);
    @after@for (int i = 0; i < NX * NX; i++) bad[0] |= !isfinite(filter->P[i]);
    return !bad[0];
}

