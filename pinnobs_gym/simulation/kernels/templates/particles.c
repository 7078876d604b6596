/* The particle filter, as pinnobs_gym/estimators/particle.py says. Rows whose particles are to be
   resampled wait for a second call, since few samples need the random numbers of that. */

#define HUGE_STATE 1e150 /* absolute value from which on a particle counts as overflowed */
#define IMPOSSIBLE (-1e300) /* logarithm of the weight of a particle that is out of the question */

/* Set the logarithms of the likelihood from the outputs of the particles x (NX, members). Return 1
   if the sample is impossible for all of them. */
static int find_likelihood(const struct set *c, int64_t row, const double *x, struct room *room)
{
    const struct plan *plan = c->plan;
    lanes_1 R[NY * NY], L[NY * NY];
    double best = IMPOSSIBLE;
    load_noise(c, row, R);
    cholesky_1(NY, (const lanes_1 *)R, L);
    for (int64_t at = 0; at < c->members; at += W) {
        const int count = (int)MIN(c->members - at, W);
        lanes error[NY], point[NX], sizes;
        int64_t outside[W] = {0};
        AT_WIDTH(load)(NY, room->outputs, c->members, at, count, error);
        AT_WIDTH(load)(NX, x, c->members, at, count, point);
        EACH_LANE sizes[l] = 0;
        for (int i = 0; i < NY; i++) {
            const double y = c->y[i * c->batch + row];
            EACH_LANE error[i][l] = y - error[i][l];
            if (plan->output_period && plan->output_period[i])
                EACH_LANE error[i][l] = wrapped(error[i][l], plan->output_period[i]);
            if (isnan(y)) EACH_LANE error[i][l] = 0;
            for (int j = 0; j < i; j++) /* forward substitution */
                EACH_LANE error[i][l] -= L[i * NY + j][0] * error[j][l];
            EACH_LANE error[i][l] /= L[i * NY + i][0];
            EACH_LANE sizes[l] += error[i][l] * error[i][l];
        }
        for (int i = 0; plan->low && i < NX; i++)
            EACH_LANE outside[l] |=
                (point[i][l] < plan->low[i]) | (point[i][l] > plan->high[i]);
        EACH_LANE sizes[l] = outside[l] || !isfinite(sizes[l]) ? IMPOSSIBLE : -0.5 * sizes[l];
        AT_WIDTH(store)(1, (const lanes *)&sizes, room->likelihood, c->members, at, count);
    }
    for (int64_t k = 0; k < c->members; k++) best = maximum(room->likelihood[k], best);
    return !(best > IMPOSSIBLE);
}

/* Apply the likelihood in a row: all that is left of it, or a power after which the particles are to
   be resampled. Return what is to be done; x and P of the row are set. */
static int64_t apply_likelihood(const struct set *c, const struct places *to, int64_t row,
                                struct room *room, double left)
{
    const int64_t batch = c->batch, members = c->members;
    double *const x = to->points + row * NX * members, mean[NX], P[NX * NX];
    double *const log_weights = to->log_weights + row * members;
    double power = to->remaining[row];
    const int tempered = left < c->few && c->rounds > 0;
    if (tempered) {
        power = tempering_power(members, log_weights, power, room);
        weigh(members, log_weights, power, room);
    }
    take_weights(members, power, room, log_weights);
    to->remaining[row] -= power;
    gather(NX, c->plan->state_period, members, room->w, x);
    find_means(NX, members, room->w, 1, x, mean);
    find_covariances(NX, members, room->w, 1, x, mean, P);
    for (int i = 0; i < NX; i++) to->x[i * batch + row] = mean[i];
    for (int i = 0; i < NX * NX; i++) to->P[i * batch + row] = P[i];
    if (!all_finite(NX, mean) || !all_finite(NX * NX, P)) return LEFT;
    if (tempered) return TEMPERED;
    return weighted_sum(members, room->w, room->w) > 2.0 / members ? FEW : DONE;
}

/* Find the predicted outputs of a row, their innovations and the covariances of these. Return 1 if
   NumPy has to process the row. The outputs are gathered by weights w that sum to one. */
static int predict_outputs(const struct set *c, const struct places *to, int64_t row,
                           const struct interval *over, const double *x, struct room *room)
{
    const int64_t batch = c->batch, members = c->members;
    double mean[NX], P[NX * NX], yhat[NY], S[NY * NY], e[NY];
    lanes_1 R[NY * NY];
    load_noise(c, row, R);
    if (c->plan->output_period) {
        find_means(NX, members, room->w, 1, x, mean);
        find_covariances(NX, members, room->w, 1, x, mean, P);
        if (may_turn(c, over, row, 0, mean, P)) return 1;
    }
    find_outputs(over, c->y + row, batch, members, x, room->outputs);
    if (!all_finite(NY * members, room->outputs)) return 1;
    gather(NY, c->plan->output_period, members, room->w, room->outputs);
    find_means(NY, members, room->w, 1, room->outputs, yhat);
    find_covariances(NY, members, room->w, 1, room->outputs, yhat, S);
    find_innovations(c, row, yhat, e);
    for (int i = 0; i < NY; i++) to->e[i * batch + row] = e[i];
    for (int i = 0; i < NY * NY; i++) to->S[i * batch + row] = S[i] + R[i][0];
    return !all_finite(NY, yhat) || !all_finite(NY * NY, S);
}

/* Begin the sample in a row. Return what is to be done. */
static int64_t begin_row(const struct set *c, const struct places *to, int64_t row,
                         struct room *room)
{
    const int64_t members = c->members;
    const struct places from = find_places(c->before, c->batch, members);
    double *const x = to->points + row * NX * members;
    double *const log_weights = to->log_weights + row * members;
    lanes p[LP];
    struct interval over;
    int lost = 0;
    memcpy(x, from.points + row * NX * members, (size_t)(NX * members) * sizeof *x);
    memcpy(log_weights, from.log_weights + row * members, (size_t)members * sizeof *x);
    set_interval(c, to, row, p, &over);
    if (!c->first) move_points(&over, c->draws ? room->drawn : NULL, members, x);
    for (int64_t k = 0; k < NX * members; k++) lost |= !(fabs(x[k]) < HUGE_STATE);
    if (lost) return LEFT;
    for (int64_t k = 0; k < members; k++) room->w[k] = exponential(log_weights[k]);
    if (!c->first) gather(NX, c->plan->state_period, members, room->w, x);
    if (predict_outputs(c, to, row, &over, x, room)) return LEFT;
    if (find_likelihood(c, row, x, room)) return LEFT;
    const double left = weigh(members, log_weights, 1, room);
    to->remaining[row] = 1;
    to->collapses[row] = from.collapses[row] + (left < c->collapsed);
    const int64_t told = to->collapses[row] > c->most ? COLLAPSED : 0;
    return told | apply_likelihood(c, to, row, room, left);
}

/* Resample the particles of a row systematically, with kernels that keep the mean and the covariance
   of the set. Return 1 if NumPy has to do it, because the covariance has no root. */
static int resample_row(const struct set *c, const struct places *to, int64_t row,
                        struct room *room)
{
    const int64_t batch = c->batch, members = c->members;
    const double a = c->shrinkage[row], width = sqrt(1 - a * a);
    double *const x = to->points + row * NX * members, *const old = room->old, cumulated = 0;
    double *const log_weights = to->log_weights + row * members;
    lanes_1 P[NX * NX], L[NX * NX];
    int64_t bad[1] = {0};
    load_1(NX * NX, to->P, batch, row, 1, P);
    if (a < 1) {
        cholesky_1(NX, (const lanes_1 *)P, L);
        mark_without_root_1(NX, (const lanes_1 *)P, (const lanes_1 *)L, bad);
        if (bad[0]) return 1;
    }
    memcpy(old, x, (size_t)(NX * members) * sizeof *x);
    for (int64_t k = 0, next = 0; k < members; k++) {
        cumulated += exponential(log_weights[k]);
        double end = minimum(ceil(cumulated * members - c->uniform), members);
        if (k == members - 1) end = members;
        for (; next < end; next++) /* another copy of particle k */
            for (int i = 0; i < NX; i++) x[i * members + next] = old[i * members + k];
    }
    for (int64_t k = 0; k < members; k++) log_weights[k] = -log((double)members);
    for (int i = 0; a < 1 && i < NX; i++) {
        const double mean = to->x[i * batch + row];
        for (int64_t k = 0; k < members; k++) {
            double noise = 0;
            for (int j = 0; j <= i; j++)
                noise += width * L[i * NX + j][0] * room->drawn[j * members + k];
            x[i * members + k] = a * x[i * members + k] + (1 - a) * mean + noise;
        }
    }
    return 0;
}

/* Go on with a tempered row: resample it, and apply what is left of the likelihood. */
static int64_t continue_row(const struct set *c, const struct places *to, int64_t row,
                            struct room *room)
{
    double *const x = to->points + row * NX * c->members;
    lanes p[LP];
    struct interval over;
    if (resample_row(c, to, row, room)) return LEFT;
    set_interval(c, to, row, p, &over);
    find_outputs(&over, c->y + row, c->batch, c->members, x, room->outputs);
    if (find_likelihood(c, row, x, room)) return LEFT;
    const double left =
        weigh(c->members, to->log_weights + row * c->members, to->remaining[row], room);
    return apply_likelihood(c, to, row, room, left);
}

/* Set up the arrays of a call, with ``numbers`` normal numbers of each particle. Return 0 if there is
   no memory for them. */
static int set_up(const struct set *c, int64_t numbers, struct room *room)
{
    const int64_t members = c->members;
    room->drawn = malloc((size_t)((numbers + 3 + NY + NX) * members) * sizeof *room->drawn);
    room->likelihood = room->drawn + numbers * members;
    room->w = room->likelihood + members;
    room->outputs = room->w + members;
    room->old = room->outputs + NY * members;
    room->ones = room->old + NX * members;
    for (int64_t k = 0; room->drawn && k < members; k++) room->ones[k] = 1;
    return room->drawn != NULL;
}

/* Begin a sample. Returns what is to be done in some of the rows, -1 if NumPy has to process all. */
int64_t begin(const struct set *call, const double *y, const double *u)
{
    struct set whole = *call;
    whole.y = y;
    whole.u = u;
    const struct set *const c = &whole;
    const struct places to = find_places(c->to, c->batch, c->members);
    const int64_t numbers = (c->plan->discrete ? 1 : 2) * c->plan->m;
    const int64_t count = c->draws ? noisy_steps(c->plan, c->before[0], c->t) : 0;
    int64_t any = 0;
    struct room room;
    if (!set_up(c, count * numbers, &room)) return -1;
    if (count > 0) transpose(count, c->members, numbers, c->draws, room.drawn);
    take_sample(c, &to);
    for (int64_t row = 0; row < c->batch; row++) {
        if (to.left[row] == DONE) to.left[row] = begin_row(c, &to, row, &room);
        any |= to.left[row];
        to.left[row] &= ~COLLAPSED;
    }
    free(room.drawn);
    return any;
}

/* Resample the rows in which it is to be done: those that are tempered, which go on, or those with
   few effective particles after the sample. Returns what is to be done then, as ``begin``. */
int64_t resample(const struct set *call, const double *y, int64_t kind)
{
    struct set whole = *call;
    whole.y = y;
    const struct set *const c = &whole;
    const struct places to = find_places(c->to, c->batch, c->members);
    int64_t any = 0;
    struct room room;
    if (!set_up(c, NX, &room)) return -1;
    transpose(1, c->members, NX, c->more, room.drawn);
    for (int64_t row = 0; row < c->batch; row++) {
        if (to.left[row] == kind && kind == TEMPERED)
            to.left[row] = continue_row(c, &to, row, &room);
        else if (to.left[row] == kind)
            to.left[row] = resample_row(c, &to, row, &room) ? LEFT : DONE;
        any |= to.left[row];
    }
    free(room.drawn);
    return any;
}
