/* The entries. */

/* Filter the rows in groups of WIDE lanes, or one by one if they are few. ``reached`` (batch,) is
   set to the number of the sample that NumPy has to do in each row, or the number of samples.
   Returns 0 if there is none to do. */
int64_t run(const struct call *c, int64_t *reached)
{
    int64_t left = 0;
    for (int64_t row = 0; row < c->batch;) {
        const int64_t rest = c->batch - row;
        const int count = rest < 3 ? 1 : (int)MIN(rest, WIDE);
        if (count == 1) filter_rows_1(c, row, 1, reached + row);
        else FILTER_WIDE(c, row, count, reached + row);
        for (int l = 0; l < count; l++) left |= reached[row + l] < c->samples;
        row += count;
    }
    return left;
}

/* Filter one sample. Buffers hold one after the other t, y, u, x, P, the innovation, S, and the
   numbers of ``reached``, with the batch as the last axis: ``to`` with the sample's t, y and u, and
   ``from`` the sample before. If this is the first sample, x and P of ``from`` are predictions.
   ``more`` has further arrays, or is NULL. */
int64_t update(const struct plan *plan, int64_t batch, int64_t first, double *to,
               const double *from, const struct call *more)
{
    const int64_t u = 1 + NY * batch, x = u + NU * batch, P = x + NX * batch,
                  e = P + NX * NX * batch, S = e + NY * batch, end = S + NY * NY * batch;
    struct call c = {0};
    if (more) c = *more;
    c.plan = plan;
    c.batch = batch;
    c.samples = 1;
    c.t = to;
    c.y = to + 1;
    c.u = to + u;
    c.x = to + x;
    c.P = to + P;
    c.innovation = to + e;
    c.S = to + S;
    c.t_before = first ? NULL : from;
    c.u_before = from + u;
    c.x_before = from + x;
    c.P_before = from + P;
    return run(&c, (int64_t *)(to + end));
}
