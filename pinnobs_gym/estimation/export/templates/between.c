/* The interval from the last sample to a new one. */
static struct interval interval_to(const @name@ *filter, const struct sample *now, seconds t)
{
    struct interval over = {.plan = &plan, .p = plan.p, .t0 = filter->t, .t1 = t};
    memcpy(over.u0, filter->u, sizeof over.u0);
    memcpy(over.u1, now->u, sizeof over.u1);
    return over;
}
