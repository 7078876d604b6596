/* Check a sample, and complete it by the inputs and the noise. */
static @name@_status checked(const @name@ *filter, seconds t, const real *y, const real *u,
                             struct sample *now)
{
    const int first = filter->samples == 0;
    if (!isfinite(t) || (!first && !(t > filter->t))) return @NAME@_TIME;
    if (plan.discrete && t != floor(t)) return @NAME@_TIME;
    if (!first && !movable(&plan, filter->t, t)) return @NAME@_GAP;
    memset(now, 0, sizeof *now);
    now->t[0] = (real)t;
    for (int i = 0; i < NY; i++) {
        if (isinf(y[i])) return @NAME@_OUTPUT;
        now->y[i] = y[i];
    }
    if (plan.input)
        for (int i = 0; i < NU; i++) {
            if (!isfinite(u[i])) return @NAME@_INPUT;
            now->u[i] = u[i];
        }
    else
        known_input(&plan, plan.p, t, now->u);
    return @NAME@_OK;
}

@name@_status @name@_update(@name@ *filter, double t, const @real@ *y, const @real@ *u)
{
    struct sample now;
    @name@ next = *filter; /* a sample that is refused leaves the filter as it is */
    const @name@_status status = checked(filter, t, y, u, &now);
    if (status != @NAME@_OK) return status;
    if (!advance(&next, &now, t)) return @NAME@_NUMERICS;
    for (int i = 0; i < NX; i++)
        if (!isfinite(next.x[i])) return @NAME@_NUMERICS;
    next.t = t;
    next.samples++;
    memcpy(next.u, now.u, sizeof next.u);
    *filter = next;
    return @NAME@_OK;
}
