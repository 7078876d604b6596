void @name@_init(@name@ *filter, const @real@ *xhat0, const @real@ *P0)
{
    memset(filter, 0, sizeof *filter);
    memcpy(filter->x, xhat0 ? xhat0 : prior_mean, sizeof filter->x);
    memcpy(filter->P, P0 ? P0 : prior_cov, sizeof filter->P);
    after_prediction(&plan, filter->x, filter->P);
}

@name@_status @name@_update(@name@ *filter, double t, const @real@ *y, const @real@ *u)
{
    struct interval over = {.plan = &plan, .p = plan.p, .t0 = filter->t, .t1 = t};
    struct sample now;
    struct memory memory;
    real x[NX], P[NX * NX], sum = 0;
    int64_t bad[1] = {0};
    const int first = filter->samples == 0;
    /* Check the sample; a filter whose sample is refused stays as it is. */
    if (!isfinite(t) || (!first && !(t > filter->t))) return @NAME@_TIME;
    if (plan.discrete && t != floor(t)) return @NAME@_TIME;
    if (!first && !movable(&plan, filter->t, t)) return @NAME@_GAP;
    for (int i = 0; i < NY; i++)
        if (isinf(y[i])) return @NAME@_OUTPUT;
    memset(&now, 0, sizeof now);
    now.t[0] = (real)t;
    memcpy(now.y, y, sizeof now.y);
    if (plan.input) {
        for (int i = 0; i < NU; i++) {
            if (!isfinite(u[i])) return @NAME@_INPUT;
            now.u[i] = u[i];
        }
    } else {
        known_input(&plan, plan.p, t, now.u);
    }
    memcpy(now.R, output_noise, sizeof now.R);
    leave_out_missing(now.y, now.R);
    /* Predict from the sample before, and correct. */
    memcpy(x, filter->x, sizeof x);
    memcpy(P, filter->P, sizeof P);
    memcpy(over.u0, filter->u, sizeof over.u0);
    memcpy(over.u1, now.u, sizeof over.u1);
    memset(&memory, 0, sizeof memory);
    @before@
    if (!first) {
        predict(&over, x, P, bad);
        after_prediction(&plan, x, P);
    }
    correct(&plan, plan.p, &now, x, P, &memory, bad);
    after_correction(&plan, x, P);
    for (int i = 0; i < NX; i++) sum += x[i];
    for (int i = 0; i < NX * NX; i++) sum += P[i];
    if (bad[0] || !isfinite(sum)) return @NAME@_NUMERICS;
    filter->t = t;
    filter->samples++;
    memcpy(filter->x, x, sizeof x);
    memcpy(filter->P, P, sizeof P);
    memcpy(filter->u, now.u, sizeof filter->u);
    memcpy(filter->innovation, now.e, sizeof filter->innovation);
    memcpy(filter->S, now.S, sizeof filter->S);
    @after@
    return @NAME@_OK;
}
