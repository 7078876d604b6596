/* The entry of the smoother. */

/* Copy WIDE rows, of which the first ``count`` exist, of an array (rows, n) to one (n, WIDE). The last
   row stands for those that do not exist. */
static void gather(const double *restrict from, int64_t n, int64_t row, int count,
                   lanes *restrict to)
{
    for (int l = 0; l < W; l++) {
        const double *one = from + (row + MIN(l, count - 1)) * n;
        for (int64_t i = 0; i < n; i++) to[i][l] = one[i];
    }
}

/* Copy the rows that exist of an array (n, WIDE) to one (rows, n). */
static void scatter(const lanes *restrict from, int64_t n, int64_t row, int count,
                    double *restrict to)
{
    for (int l = 0; l < count; l++) {
        double *one = to + (row + l) * n;
        for (int64_t i = 0; i < n; i++) one[i] = from[i][l];
    }
}

/* Take n lanes of the scratch memory. */
static double *take(lanes **scratch, int64_t n)
{
    lanes *const taken = *scratch;
    *scratch += n;
    return taken[0];
}

/* The number of entries of the scratch memory: what is kept of WIDE rows, side by side */
int64_t scratch_entries(int64_t samples)
{
    const int64_t each = 2 * NX + 4 * NX * NX + NY + NU + NY * NY;
    return W * (samples * each + NP + NX + NX * NX);
}

/* Smooth a batch of records in groups of WIDE rows. ``left`` (batch,) is set to 1 in the rows that
   NumPy has to smooth. The row is the first axis of y (batch, samples, NY), u, mean (batch, NX), cov
   and of the results x (batch, samples, NX) and P, and the last of what the plan points to. */
void smooth(const struct plan *given, int64_t batch, int64_t samples, double least,
            const double *t, const double *y, const double *u, const double *mean,
            const double *cov, double *x, double *P, double *scratch, int64_t *left)
{
    for (int64_t row = 0; row < batch; row += W) {
        const int count = (int)MIN(batch - row, W);
        int64_t reached[W], near[W];
        struct plan plan = *given;
        struct call c = {.plan = &plan, .batch = W, .samples = samples, .t = t};
        lanes *rest = (lanes *)scratch, *own_y, *own_u, *x_before, *P_before;
        c.y = take(&rest, samples * NY), own_y = (lanes *)c.y;
        c.u = take(&rest, samples * NU), own_u = (lanes *)c.u;
        c.x_before = take(&rest, NX), x_before = (lanes *)c.x_before;
        c.P_before = take(&rest, NX * NX), P_before = (lanes *)c.P_before;
        c.x = take(&rest, samples * NX);
        c.P = take(&rest, samples * NX * NX);
        c.x_predicted = take(&rest, samples * NX);
        c.P_predicted = take(&rest, samples * NX * NX);
        c.F = take(&rest, samples * NX * NX);
        c.Q = take(&rest, samples * NX * NX);
        gather(y, samples * NY, row, count, own_y);
        gather(u, samples * NU, row, count, own_u);
        gather(mean, NX, row, count, x_before);
        gather(cov, NX * NX, row, count, P_before);
        if (given->p_rows) {
            plan.p = take(&rest, NP);
            AT_WIDTH(load)(NP, given->p, batch, row, count, (lanes *)plan.p);
        }
        if (given->R_rows) {
            const int64_t n = (given->R_samples ? samples : 1) * NY * NY;
            plan.R = take(&rest, n);
            AT_WIDTH(load)(n, given->R, batch, row, count, (lanes *)plan.R);
        }
        FILTER_WIDE(&c, 0, W, reached);
        int any = 0;
        for (int l = 0; l < W; l++) {
            near[l] = reached[l] < samples;
            any |= !near[l];
        }
        if (any) SMOOTH_WIDE(&c, least, near);
        for (int l = 0; l < count; l++) left[row + l] = near[l];
        scatter((lanes *)c.x, samples * NX, row, count, x);
        scatter((lanes *)c.P, samples * NX * NX, row, count, P);
    }
}
