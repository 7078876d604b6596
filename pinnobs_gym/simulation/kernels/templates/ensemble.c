/* The ensemble Kalman filter, as pinnobs_gym/estimators/enkf.py says. */

/* Arrays that the rows of a call share, and outputs of a row */
struct room {
    double *drawn;            /* normal numbers (steps, 2 m or m, members) of the process noise */
    double *more;             /* those (num_more, members) of the outputs' noise */
    double *ones;             /* (members,) */
    double *outputs;          /* (NY, members) */
};

/* What an analysis needs beside the members: means and covariances of the prediction, the gain, and
   the factors of the deviations after it */
struct analysis {
    double mean[NX], yhat[NY], P[NX * NX], factor[NX];
    lanes_1 R[NY * NY], S[NY * NY], between[NX * NY], K[NX * NY];
};

/* Give each of some normal numbers (number, members) mean zero and unit variance. */
static void standardise(int64_t number, int64_t members, double *numbers)
{
    for (int64_t i = 0; i < number; i++, numbers += members) {
        double mean = 0, variance = 0;
        for (int64_t k = 0; k < members; k++) mean += numbers[k];
        mean /= members;
        for (int64_t k = 0; k < members; k++) {
            numbers[k] -= mean;
            variance += numbers[k] * numbers[k];
        }
        const double std = sqrt(variance / (members - 1));
        for (int64_t k = 0; k < members; k++) numbers[k] /= std;
    }
}

/* Find the gain of the predicted members x (NX, members). Return 1 if NumPy has to do it. */
static int find_gain(const struct set *c, const struct room *room, const struct interval *over,
                     int64_t row, const double *x, struct analysis *a)
{
    const int64_t members = c->members;
    const double whole = (double)(members - 1);
    double own[NY * NY];
    int64_t bad[1] = {0};
    find_means(NX, members, room->ones, (double)members, x, a->mean);
    find_means(NY, members, room->ones, (double)members, room->outputs, a->yhat);
    find_covariances(NX, members, room->ones, whole, x, a->mean, a->P);
    find_covariances(NY, members, room->ones, whole, room->outputs, a->yhat, own);
    if (may_turn(c, over, row, 1, a->mean, a->P)) return 1;
    /* S = Y Y^T + R and K = X Y^T S^-1, where outputs that are missing are zero throughout */
    for (int i = 0; i < NY * NY; i++) a->S[i][0] = own[i] + a->R[i][0];
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NY; j++)
            a->K[i * NY + j][0] = a->between[i * NY + j][0] =
                weighted_product(members, room->ones, x + i * members, a->mean[i],
                                 room->outputs + j * members, a->yhat[j]) / whole;
    divide_1(NX, (const lanes_1 *)a->S, a->K, bad);
    for (int i = 0; i < NX; i++) {
        /* The inflation gives back at most what the analysis takes from the variance of a state. */
        double taken = 0;
        for (int j = 0; j < NY; j++) taken += a->K[i * NY + j][0] * a->between[i * NY + j][0];
        const double variance = a->P[i * NX + i], share = variance > 0 ? taken / variance : 0;
        const double factor = 1 / sqrt(1 - minimum(maximum(share, 0), 1));
        a->factor[i] = minimum(maximum(factor, 1), c->inflation);
    }
    return bad[0] != 0;
}

/* Correct the members x (NX, members), each by its own perturbed output. */
static void correct_members(const struct set *c, const struct room *room, int64_t row,
                            const struct analysis *a, double *x)
{
    const struct plan *plan = c->plan;
    const double *G = c->G + (c->G_rows ? row : 0);
    const int64_t own = c->G_rows ? c->batch : 1, n = c->num_more;
    for (int64_t at = 0; at < c->members; at += W) {
        const int count = (int)MIN(c->members - at, W);
        lanes point[NX], error[NY];
        AT_WIDTH(load)(NX, x, c->members, at, count, point);
        AT_WIDTH(load)(NY, room->outputs, c->members, at, count, error);
        for (int i = 0; i < NY; i++) {
            const double y = c->y[i * c->batch + row];
            lanes noise;
            EACH_LANE noise[l] = 0;
            for (int64_t q = 0; q < n; q++) {
                lanes w;
                AT_WIDTH(load)(1, room->more + q * c->members, c->members, at, count, &w);
                EACH_LANE noise[l] += G[(i * n + q) * own] * w[l];
            }
            EACH_LANE error[i][l] = y + noise[l] - error[i][l];
            if (plan->output_period && plan->output_period[i])
                EACH_LANE error[i][l] = wrapped(error[i][l], plan->output_period[i]);
            if (isnan(y)) EACH_LANE error[i][l] = 0;
        }
        for (int j = 0; j < NY; j++)
            for (int i = 0; i < NX; i++)
                EACH_LANE point[i][l] += error[j][l] * a->K[i * NY + j][0];
        AT_WIDTH(store)(NX, (const lanes *)point, x, c->members, at, count);
    }
}

/* Process the sample in a row. Return 1 if NumPy has to do it. */
static int ensemble_row(const struct set *c, const struct room *room, const struct places *to,
                        int64_t row)
{
    const struct plan *plan = c->plan;
    const int64_t batch = c->batch, members = c->members;
    const struct places from = find_places(c->before, batch, members);
    double *const x = to->points + row * NX * members, xhat[NX], P[NX * NX], e[NY];
    lanes p[LP];
    struct interval over;
    struct analysis a;
    memcpy(x, from.points + row * NX * members, (size_t)(NX * members) * sizeof *x);
    set_interval(c, to, row, p, &over);
    if (!c->first) {
        move_points(&over, c->draws ? room->drawn : NULL, members, x);
        gather(NX, plan->state_period, members, room->ones, x);
        if (any_outside(plan, members, x)) return 1;
    }
    find_outputs(&over, c->y + row, batch, members, x, room->outputs);
    gather(NY, plan->output_period, members, room->ones, room->outputs);
    load_noise(c, row, a.R);
    if (find_gain(c, room, &over, row, x, &a)) return 1;
    correct_members(c, room, row, &a, x);
    gather(NX, plan->state_period, members, room->ones, x);
    find_means(NX, members, room->ones, (double)members, x, xhat);
    for (int i = 0; i < NX; i++)
        for (int64_t k = 0; k < members; k++)
            x[i * members + k] = xhat[i] + a.factor[i] * (x[i * members + k] - xhat[i]);
    if (any_outside(plan, members, x)) return 1;
    find_covariances(NX, members, room->ones, (double)(members - 1), x, xhat, P);
    find_innovations(c, row, a.yhat, e);
    for (int i = 0; i < NX; i++) to->x[i * batch + row] = xhat[i];
    for (int i = 0; i < NX * NX; i++) to->P[i * batch + row] = P[i];
    for (int i = 0; i < NY; i++) to->e[i * batch + row] = e[i];
    for (int i = 0; i < NY * NY; i++) to->S[i * batch + row] = a.S[i][0];
    /* NumPy says where values that are not finite go. */
    return !all_finite(NX, xhat) || !all_finite(NX * NX, P) || !all_finite(NY, a.yhat)
           || !all_finite(NY * NY, &a.S[0][0]) || !all_finite(NX, a.mean);
}

/* Process a sample. Returns 0 if no row is left to NumPy, -1 if all are. */
int64_t ensemble(const struct set *call, const double *y, const double *u)
{
    struct set whole = *call;
    whole.y = y;
    whole.u = u;
    const struct set *const c = &whole;
    const struct places to = find_places(c->to, c->batch, c->members);
    const int64_t members = c->members, numbers = (c->plan->discrete ? 1 : 2) * c->plan->m;
    const int64_t count = c->draws ? noisy_steps(c->plan, c->before[0], c->t) : 0;
    int64_t any = 0;
    double *const all =
        malloc((size_t)((count * numbers + c->num_more + 1 + NY) * members) * sizeof *all);
    if (!all) return -1;
    struct room room = {.drawn = all};
    room.more = room.drawn + count * numbers * members;
    room.ones = room.more + c->num_more * members;
    room.outputs = room.ones + members;
    for (int64_t k = 0; k < members; k++) room.ones[k] = 1;
    if (count > 0) transpose(count, members, numbers, c->draws, room.drawn);
    transpose(1, members, c->num_more, c->more, room.more);
    standardise(count * numbers + c->num_more, members, all);
    take_sample(c, &to);
    for (int64_t row = 0; row < c->batch; row++) {
        if (to.left[row] == DONE && ensemble_row(c, &room, &to, row)) to.left[row] = LEFT;
        any |= to.left[row];
    }
    free(all);
    return any;
}
