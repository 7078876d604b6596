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
   numbers of ``reached``, with the batch as the last axis. ``from`` is that of the sample before; if
   this is the first sample, x and P of it are predictions. ``more`` has further arrays, or is
   NULL. */
int64_t update(const struct plan *plan, int64_t batch, int64_t first, double t, const double *y,
               const double *u, double *to, const double *from, const struct call *more)
{
    double *const to_y = to + 1, *const to_u = to_y + NY * batch, *const x = to_u + NU * batch,
                  *const P = x + NX * batch, *const e = P + NX * NX * batch,
                  *const S = e + NY * batch, *const end = S + NY * NY * batch;
    struct call c = {0};
    if (more) c = *more;
    c.plan = plan;
    c.batch = batch;
    c.samples = 1;
    to[0] = t;
    for (int64_t i = 0; i < NY * batch; i++) to_y[i] = y[i];
    for (int64_t i = 0; i < NU * batch; i++) to_u[i] = u[i];
    c.t = to;
    c.y = to_y;
    c.u = to_u;
    c.x = x;
    c.P = P;
    c.innovation = e;
    c.S = S;
    c.t_before = first ? NULL : from;
    c.u_before = from + (to_u - to);
    c.x_before = from + (x - to);
    c.P_before = from + (P - to);
    return run(&c, (int64_t *)end);
}
