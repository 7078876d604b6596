/* Take the last sample of a call into the windows of a batch. Returns 0 if no row is left to NumPy. */
int64_t slide(const struct window *c)
{
    const struct plan *plan = c->plan;
    const double t = c->t[c->samples - 1], before = c->samples > 1 ? c->t[c->samples - 2] : t;
    const int whole = !plan->discrete || t == floor(t);
    const int short_enough = (t - before) / (plan->discrete ? 1 : plan->longest) < MOST_STEPS;
    int64_t any = 0;
    for (int64_t row = 0; row < c->batch; row++)
        c->left[row] = !whole || !short_enough
                       || other_inputs(plan, c->batch, row, t,
                                       c->u + (c->samples - 1) * NU * c->batch);
    for (int64_t row = 0; short_enough && row < c->batch; row += WIDE)
        WINDOW_WIDE(c, row, (int)MIN(c->batch - row, WIDE));
    for (int64_t row = 0; row < c->batch; row++) any |= c->left[row];
    return any;
}
