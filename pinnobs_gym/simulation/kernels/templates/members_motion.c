/* The motion of sets of points from one sample to the next, with process noise. */

/* Copy normal numbers (number, members, n) to (number, n, members). */
static void transpose(int64_t number, int64_t members, int64_t n, const double *from, double *to)
{
    for (int64_t s = 0; s < number; s++, from += members * n, to += members * n)
        for (int64_t k = 0; k < members; k++)
            for (int64_t i = 0; i < n; i++) to[i * members + k] = from[k * n + i];
}

/* Forces L w of a step: white noise projected on linear functions of time. ``drawn`` (2 m, members)
   are normal numbers. */
static inline void forces(const struct plan *plan, double h, const double *drawn, int64_t members,
                          int64_t at, int count, lanes (*restrict force)[NX])
{
    const double root = sqrt(h);
    memset(force, 0, 3 * sizeof *force);
    for (int64_t j = 0; j < plan->m; j++) {
        lanes even, odd, w[3];
        AT_WIDTH(load)(1, drawn + j * members, members, at, count, &even);
        AT_WIDTH(load)(1, drawn + (plan->m + j) * members, members, at, count, &odd);
        EACH_LANE {
            even[l] /= root;
            odd[l] = sqrt(3.0) * (odd[l] / root);
            w[0][l] = even[l] - odd[l];
            w[1][l] = even[l];
            w[2][l] = even[l] + odd[l];
        }
        for (int i = 0; i < NX; i++) {
            const double entry = plan->L[i * plan->m + j];
            for (int q = 0; entry != 0 && q < 3; q++)
                EACH_LANE force[q][i][l] += w[q][l] * entry;
        }
    }
}

/* x at the end of a step of the classical Runge-Kutta method with forces at its stages */
static inline void forced_step(const struct rk_step *s, const lanes *p,
                               lanes (*restrict force)[NX], lanes *restrict x)
{
    static const int stage[4] = {0, 1, 1, 2};
    const double part[4] = {0, s->h / 2, s->h / 2, s->h};
    lanes k[4][NX], point[NX];
    for (int q = 0; q < 4; q++) {
        for (int i = 0; i < NX; i++)
            EACH_LANE point[i][l] = q ? part[q] * k[q - 1][i][l] + x[i][l] : x[i][l];
        AT_WIDTH(plant_f)((const double *)(s->t + stage[q]), (const lanes *)point,
                          (const lanes *)s->u[stage[q]], p, k[q]);
        for (int i = 0; i < NX; i++) EACH_LANE k[q][i][l] += force[stage[q]][i][l];
    }
    for (int i = 0; i < NX; i++)
        EACH_LANE x[i][l] +=
            s->h / 6 * ((k[1][i][l] + k[2][i][l]) * 2 + k[0][i][l] + k[3][i][l]);
}

/* Move states that noise moved beyond a bound to that bound. */
static inline void absorb(const struct plan *plan, lanes *restrict x)
{
    for (int i = 0; plan->low && i < NX; i++)
        EACH_LANE x[i][l] = absorbed(x[i][l], plan->low[i], plan->high[i]);
}

/* Move points x (NX, members) over a step of a map at time k. */
static void map_points(const struct interval *over, seconds k, const double *drawn, int64_t members,
                       double *x)
{
    const struct plan *plan = over->plan;
    lanes t, u[LU];
    EACH_LANE t[l] = k;
    AT_WIDTH(input_at)(over, k, (k - over->t0) / (over->t1 - over->t0), u);
    for (int64_t at = 0; at < members; at += W) {
        const int count = (int)MIN(members - at, W);
        lanes point[NX], next[NX];
        AT_WIDTH(load)(NX, x, members, at, count, point);
        AT_WIDTH(plant_f)((const double *)t, (const lanes *)point, (const lanes *)u, over->p, next);
        for (int64_t j = 0; drawn && j < plan->m; j++) {
            lanes w;
            AT_WIDTH(load)(1, drawn + j * members, members, at, count, &w);
            for (int i = 0; i < NX; i++) EACH_LANE next[i][l] += plan->L[i * plan->m + j] * w[l];
        }
        if (drawn) absorb(plan, next);
        AT_WIDTH(store)(NX, (const lanes *)next, x, members, at, count);
    }
}

/* Move points x (NX, members) over an interval, with the normal numbers ``drawn`` (steps, 2 m or m,
   members) or, if it is NULL, without process noise. */
static void move_points(const struct interval *over, const double *drawn, int64_t members,
                        double *x)
{
    const struct plan *plan = over->plan;
    const int64_t numbers = (plan->discrete ? 1 : 2) * plan->m * members;
    int64_t number = 0;
    if (plan->discrete) {
        for (seconds k = over->t0; k < over->t1; k++, number++)
            map_points(over, k, drawn ? drawn + number * numbers : NULL, members, x);
        return;
    }
    struct steps at_step = {.begun = 0};
    struct rk_step s = {.h = 0};
    for (; AT_WIDTH(next_step)(over, &at_step, &s); number++)
        for (int64_t at = 0; at < members; at += W) {
            const int count = (int)MIN(members - at, W);
            lanes point[NX], force[3][NX];
            AT_WIDTH(load)(NX, x, members, at, count, point);
            if (drawn) {
                forces(plan, s.h, drawn + number * numbers, members, at, count, force);
                forced_step(&s, over->p, force, point);
                absorb(plan, point);
            } else {
                AT_WIDTH(runge_kutta)(&s, over->p, point);
            }
            AT_WIDTH(store)(NX, (const lanes *)point, x, members, at, count);
        }
}

/* Number of steps between two samples, each of which takes its own normal numbers; -1 if the model
   cannot be moved between these here */
int64_t noisy_steps(const struct plan *plan, double t0, double t1)
{
    struct interval over = {.plan = plan, .t0 = t0, .t1 = t1};
    struct steps at = {.begun = 0};
    int64_t count = 0;
    if (!movable_1(plan, t0, t1)) return -1;
    if (plan->discrete) return (int64_t)(t1 - t0);
    while (AT_WIDTH(locate_step)(&over, &at)) count++;
    return count;
}
