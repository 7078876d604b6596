/* The entries. */

/* Number of entries of results that are written before others: about a quarter of a megabyte */
#define CACHED 32768

/* Return the call of the samples from one on. */
static struct call later(const struct call *c, int64_t k)
{
    struct call part = *c;
    const int64_t rows = k * c->batch;
    if (k == 0) return part;
    part.t += k;
    part.y += rows * NY;
    part.u += rows * NU;
    part.x += rows * NX;
    part.P += rows * PP;
    if (part.innovation) part.innovation += rows * NY;
    part.S += rows * SS;
    part.t_before = part.t - 1;
    part.u_before = part.u - c->batch * NU;
    part.x_before = part.x - c->batch * NX;
    part.P_before = part.P - c->batch * PP;
    return part;
}

/* Return the number of rows from one on, at most WIDE, that are filtered side by side: those up to
   the next that has been left to NumPy; -1 if this is one. */
static int64_t group(const int64_t *reached, int64_t row, int64_t batch, int64_t samples)
{
    int64_t count = 0;
    const int64_t most = MIN(batch - row, WIDE);
    while (count < most && reached[row + count] == samples) count++;
    return count ? count : -1;
}

/* Filter the rows in groups of WIDE lanes, or a row that is left over alone. ``reached`` (batch,) is
   set to the number of the sample that NumPy has to do in each row, or the number of samples. Returns
   0 if there is none to do.

   All rows are filtered through some samples, whose results stay in the cache while they are
   written, before the next samples. */
int64_t run(const struct call *c, int64_t *reached)
{
    const int64_t entries = c->batch * (NX + PP + NY + SS);
    const int64_t fitting = entries ? CACHED / entries : 0, block = fitting < 8 ? 8 : fitting;
    int64_t left = 0;
    for (int64_t row = 0; row < c->batch; row++) reached[row] = c->samples;
    for (int64_t k = 0; k < c->samples; k += block) {
        struct call part = later(c, k);
        struct plan plan = *c->plan;
        plan.R += k * plan.R_samples * NY * NY * (plan.R_rows ? c->batch : 1);
        part.plan = &plan;
        part.samples = MIN(block, c->samples - k);
        for (int64_t row = 0, count; row < c->batch; row += count) {
            int64_t number[WIDE];
            count = group(reached, row, c->batch, c->samples);
            if (count < 0) { /* the row has stopped */
                count = 1;
                continue;
            }
            if (count == 1) filter_rows_1(&part, row, 1, number);
            else FILTER_WIDE(&part, row, (int)count, number);
            for (int l = 0; l < count; l++)
                if (number[l] < part.samples) {
                    reached[row + l] = k + number[l];
                    left = 1;
                }
        }
    }
    return left;
}

/* Leave rows to NumPy, which says what is wrong, at a time between the steps of a map, and those
   whose inputs are not the ones that the plant defines. Returns 0 if there are none. */
static int64_t mark_unusable(const struct call *c, int64_t *reached)
{
    int64_t found = 0;
    for (int64_t row = 0; row < c->batch; row++)
        if ((c->plan->discrete && c->t[0] != floor(c->t[0]))
            || other_inputs(c->plan, c->batch, row, c->t[0], c->u))
            reached[row] = 0, found = 1;
    return found;
}

/* Filter one sample. Buffers hold one after the other t, y, u, x, P, the innovation, S, and the
   numbers of ``reached``, with the batch as the last axis. ``from`` is that of the sample before; if
   this is the first sample, x and P of it are predictions. ``more`` has further arrays, or is
   NULL; without u the inputs are those that the plant defines. */
int64_t update(const struct plan *plan, int64_t batch, int64_t first, double t, const double *y,
               const double *u, double *to, const double *from, const struct call *more)
{
    double *const to_y = to + 1, *const to_u = to_y + NY * batch, *const x = to_u + NU * batch,
                  *const P = x + NX * batch, *const e = P + PP * batch,
                  *const S = e + NY * batch, *const end = S + SS * batch;
    struct call c = {0};
    if (more) c = *more;
    c.plan = plan;
    c.batch = batch;
    c.samples = 1;
    to[0] = t;
    for (int64_t i = 0; i < NY * batch; i++) to_y[i] = y[i];
    for (int64_t row = 0; NU && !u && row < batch; row++) {
        double known[LU];
        defined_inputs(plan, batch, row, t, known);
        for (int i = 0; i < NU; i++) to_u[i * batch + row] = known[i];
    }
    for (int64_t i = 0; u && i < NU * batch; i++) to_u[i] = u[i];
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
    const int64_t left = run(&c, (int64_t *)end);
    return mark_unusable(&c, (int64_t *)end) | left;
}
