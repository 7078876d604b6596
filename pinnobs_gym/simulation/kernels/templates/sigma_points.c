/* Sigma-point filters, as pinnobs_gym/estimation/sigma_points.py says. */

/* Largest number of points */
#undef POINTS
#define POINTS (2 * NX + 1)

/* The symmetric c = a a^T for a (n, k) */
static inline void AT_WIDTH(squared)(int n, int k, const lanes *restrict a, lanes *restrict c)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double sum[W];
            EACH_LANE sum[l] = a[i * k][l] * a[j * k][l];
            for (int q = 1; q < k; q++) EACH_LANE sum[l] += a[i * k + q][l] * a[j * k + q][l];
            EACH_LANE c[i * n + j][l] = c[j * n + i][l] = sum[l];
        }
}

/* Points (num_points, NX) of the distribution with mean x and covariance P. Lanes where P has no
   root, or a point is outside of the bounds, are marked. */
SEPARATE void AT_WIDTH(draw)(const struct plan *plan, const lanes *restrict x,
                             const lanes *restrict P, lanes *restrict points,
                             int64_t *restrict bad)
{
    lanes L[NX * NX];
    AT_WIDTH(cholesky)(NX, P, L);
    AT_WIDTH(mark_without_root)(NX, P, L, bad);
    for (int p = 0; p < plan->num_points; p++) {
        lanes *point = points + p * NX;
        for (int i = 0; i < NX; i++) {
            double step[W];
            EACH_LANE step[l] = 0;
            for (int j = 0; j <= i; j++) {
                const double unit = plan->points[p * NX + j];
                if (unit != 0) EACH_LANE step[l] += unit * L[i * NX + j][l];
            }
            EACH_LANE point[i][l] = step[l] + x[i][l];
        }
        AT_WIDTH(mark_outside)(plan, point, bad);
    }
}

/* Mark the lanes in which the n values at the centre are finite, but not those at all points: the
   function is not defined there. */
static inline void AT_WIDTH(mark_undefined)(const struct plan *plan, int n,
                                            const lanes *restrict centre,
                                            const lanes *restrict values, int64_t *restrict bad)
{
    int64_t defined[W], all[W];
    EACH_LANE defined[l] = all[l] = 1;
    for (int i = 0; i < n; i++) EACH_LANE defined[l] &= isfinite(centre[i][l]) != 0;
    for (int i = 0; i < plan->num_points * n; i++) EACH_LANE all[l] &= isfinite(values[i][l]) != 0;
    EACH_LANE bad[l] |= defined[l] & !all[l];
}

/* Mean (n), and weighted deviations X (n, num_points), of values (num_points, n). Those that repeat
   are taken near those at the centre. */
SEPARATE void AT_WIDTH(deviations)(const struct plan *plan, int n, const double *period,
                                   const lanes *restrict centre, lanes *restrict values,
                                   lanes *restrict mean, lanes *restrict X)
{
    const int points = (int)plan->num_points;
    for (int i = 0; i < n; i++) {
        if (period && period[i])
            for (int p = 0; p < points; p++)
                EACH_LANE values[p * n + i][l] =
                    nearest(values[p * n + i][l], centre[i][l], period[i]);
        double sum[W];
        EACH_LANE sum[l] = plan->weights[0] * values[i][l];
        for (int p = 1; p < points; p++)
            EACH_LANE sum[l] += plan->weights[p] * values[p * n + i][l];
        EACH_LANE mean[i][l] = sum[l];
        for (int p = 0; p < points; p++)
            EACH_LANE X[i * points + p][l] = (values[p * n + i][l] - sum[l]) * plan->roots[p];
    }
}

/* Move points (num_points, NX) over an interval. */
static inline void AT_WIDTH(move_points)(const struct interval *over, lanes *restrict points)
{
    const int num_points = (int)over->plan->num_points;
    if (over->plan->discrete) {
        for (int p = 0; p < num_points; p++) AT_WIDTH(move)(over, points + p * NX);
        return;
    }
    struct steps at = {.begun = 0};
    struct rk_step s = {.h = 0};
    while (AT_WIDTH(next_step)(over, &at, &s))
        for (int p = 0; p < num_points; p++)
            AT_WIDTH(runge_kutta)(&s, over->p, points + p * NX);
}

/* The prediction: x = mean of the moved points, and P = their covariance + Q, which is that along
   the trajectory of x. */
static inline void AT_WIDTH(predict)(const struct interval *over, lanes *restrict x,
                                     lanes *restrict P, int64_t *restrict bad)
{
    const struct plan *plan = over->plan;
    lanes points[POINTS * NX], X[NX * POINTS], centre[NX], Q[NX * NX];
    AT_WIDTH(draw)(plan, x, P, points, bad);
    AT_WIDTH(move_points)(over, points);
    memcpy(centre, x, sizeof centre);
    for (int i = 0; i < NX * NX; i++) EACH_LANE Q[i][l] = 0;
    AT_WIDTH(move_moments)(over, centre, Q, NULL);
    AT_WIDTH(mark_undefined)(plan, NX, centre, points, bad);
    AT_WIDTH(deviations)(plan, NX, plan->state_period, centre, points, x, X);
    AT_WIDTH(squared)(NX, (int)plan->num_points, X, P);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += Q[i][l];
}

/* Enlarge R for the gain to be the mean of those with and without an outlier in each output, as
   pinnobs_gym/estimation/outliers.py says. */
SEPARATE void AT_WIDTH(inflate)(const struct plan *plan, struct sample *restrict s)
{
    const double rate = plan->outlier_rate, size = plan->outlier_size * plan->outlier_size;
    lanes factor[NY];
    for (int i = 0; i < NY; i++)
        EACH_LANE {
            const double own = s->S[i * NY + i][l], noise = s->R[i * NY + i][l];
            const double wide = own + (size - 1) * noise, e = s->e[i][l];
            const double odds =
                log(1 / rate - 1) + log(wide / own) / 2 - e * e * (1 / own - 1 / wide) / 2;
            const double outlier = 1 / (1 + exp(odds));
            const double mean = (1 - outlier) / own + outlier / wide;
            factor[i][l] = maximum((1 / mean - own) / noise + 1, 1.0);
        }
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++)
            EACH_LANE s->R[i * NY + j][l] *= sqrt(factor[i][l] * factor[j][l]);
}

/* Correct x and P by the outputs of a sample. Lanes that NumPy has to correct are marked. */
SEPARATE void AT_WIDTH(correct)(const struct plan *plan, const lanes *restrict p,
                                struct sample *restrict s, lanes *restrict x,
                                lanes *restrict P, struct memory *restrict memory,
                                int64_t *restrict bad)
{
    const int num_points = (int)plan->num_points;
    lanes *const y = s->y, *const e = s->e, *const R = s->R, *const S = s->S;
    lanes points[POINTS * NX], outputs[POINTS * NY], centre[NY];
    lanes mean[NY], X[NX * POINTS], Y[NY * POINTS], K[NX * NY];
    (void)memory;
    /* New points about the prediction, whose spread includes Q, and their outputs */
    AT_WIDTH(draw)(plan, x, P, points, bad);
    for (int q = 0; q < num_points; q++)
        AT_WIDTH(plant_h)(s->t, points + q * NX, s->u, p, outputs + q * NY);
    AT_WIDTH(plant_h)(s->t, x, s->u, p, centre);
    AT_WIDTH(mark_undefined)(plan, NY, centre, outputs, bad);
    AT_WIDTH(deviations)(plan, NY, plan->output_period, centre, outputs, mean, Y);
    for (int i = 0; i < NX; i++)
        for (int q = 0; q < num_points; q++)
            EACH_LANE X[i * num_points + q][l] = (points[q * NX + i][l] - x[i][l]) * plan->roots[q];
    /* Innovation e = y - mean; it and Y are zero for missing outputs. */
    for (int i = 0; i < NY; i++) {
        EACH_LANE e[i][l] = y[i][l] - mean[i][l];
        if (plan->output_period && plan->output_period[i])
            EACH_LANE e[i][l] = wrapped(e[i][l], plan->output_period[i]);
        EACH_LANE e[i][l] = y[i][l] != y[i][l] ? 0 : e[i][l];
        for (int q = 0; q < num_points; q++)
            EACH_LANE Y[i * num_points + q][l] = y[i][l] != y[i][l] ? 0 : Y[i * num_points + q][l];
    }
    /* S = Y Y^T + R, and K = X Y^T S^-1 */
    AT_WIDTH(squared)(NY, num_points, Y, S);
    for (int i = 0; i < NY * NY; i++) EACH_LANE S[i][l] += R[i][l];
    AT_WIDTH(mark_wide)(plan, P, S, bad);
    AT_WIDTH(outer)(NX, num_points, NY, X, Y, K);
    if (plan->outlier_rate) { /* K with a larger R, and S of a usual sample */
        lanes used[NY * NY];
        for (int i = 0; i < NY * NY; i++) EACH_LANE used[i][l] = S[i][l] - R[i][l];
        AT_WIDTH(inflate)(plan, s);
        for (int i = 0; i < NY * NY; i++) EACH_LANE used[i][l] += R[i][l];
        AT_WIDTH(divide)(NX, used, K, bad);
    } else AT_WIDTH(divide)(NX, S, K, bad);
    /* x = x + K e, and P = (X - K Y) (X - K Y)^T + K R K^T */
    lanes KR[NX * NY], own[NX * NX];
    for (int i = 0; i < NX; i++) {
        double step[W];
        EACH_LANE step[l] = K[i * NY][l] * e[0][l];
        for (int j = 1; j < NY; j++) EACH_LANE step[l] += K[i * NY + j][l] * e[j][l];
        EACH_LANE x[i][l] += step[l];
        for (int q = 0; q < num_points; q++) {
            double sum[W];
            EACH_LANE sum[l] = K[i * NY][l] * Y[q][l];
            for (int j = 1; j < NY; j++)
                EACH_LANE sum[l] += K[i * NY + j][l] * Y[j * num_points + q][l];
            EACH_LANE X[i * num_points + q][l] -= sum[l];
        }
    }
    AT_WIDTH(squared)(NX, num_points, X, P);
    AT_WIDTH(product)(NX, NY, NY, K, R, KR);
    AT_WIDTH(symmetric)(NX, NY, KR, K, own);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += own[i][l];
    AT_WIDTH(mark_outside)(plan, x, bad);
}
