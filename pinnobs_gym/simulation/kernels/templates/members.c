/* Sets of points: the members of an ensemble, or particles. Each row of a batch has its own, arrays
   (n, members), of which W members are side by side in lanes. A row is thus the same alone and in
   any batch. */
#include <stdlib.h>

/* What a call is given. */
struct set {
    /* the same at all samples */
    int64_t members;
    int64_t num_more;         /* further normal numbers of each member */
    double inflation;         /* of ensembles */
    double few, collapsed;    /* effective numbers of particles below which they are tempered, and
                                 below which that is a collapse */
    /* of a sample */
    const struct plan *plan;
    int64_t batch;
    int64_t first;            /* 1 if no sample has been before: points are then predictions */
    double t;
    double *to;               /* buffer of the state after the sample, see ``struct places`` */
    const double *before;     /* that of the state before */
    const double *draws;      /* normal numbers of the process noise: (steps, members, 2 m), of a
                                 map (steps, members, m); NULL without process noise */
    const double *more;       /* (members, num_more) */
    const double *G;          /* of ensembles: root of R, (NY, num_more, 1 or batch) */
    int64_t G_rows;           /* 1, or 0 if G is the same in all rows */
    double most;              /* number of collapses beyond which it is said */
    int64_t rounds;           /* of tempering that are left */
    const double *shrinkage;  /* of kernels of particles, (batch,) */
    double uniform;           /* number in [0, 1) with which particles are resampled */
    /* outputs (NY, batch) and inputs (NU, batch); without u those that the plant defines */
    const double *y, *u;
};

/* Parts of a buffer: t, y, u, x, P, the innovation, S, marks of rows, and the points (batch, NX,
   members). Particles have more: the logarithms of weights (batch, members), the number of collapses
   (batch,) and the power of the likelihood that is left (batch,). */
struct places {
    double *y, *u, *x, *P, *e, *S;
    int64_t *left;            /* what is to be done in a row, 0 for nothing */
    double *points, *log_weights, *collapses, *remaining;
};
enum { DONE = 0, LEFT = 1, TEMPERED = 2, FEW = 4, COLLAPSED = 8 };

static struct places find_places(const double *buffer, int64_t batch, int64_t members)
{
    struct places at = {.y = (double *)buffer + 1};
    at.u = at.y + NY * batch;
    at.x = at.u + NU * batch;
    at.P = at.x + NX * batch;
    at.e = at.P + NX * NX * batch;
    at.S = at.e + NY * batch;
    at.left = (int64_t *)(at.S + NY * NY * batch);
    at.points = (double *)(at.left + batch);
    at.log_weights = at.points + NX * members * batch;
    at.collapses = at.log_weights + members * batch;
    at.remaining = at.collapses + batch;
    return at;
}

/* Write the sample of a call to its buffer. Rows whose inputs are not those that the plant defines
   are left to NumPy, which says so, and all of them where the model cannot be moved to the sample. */
static void take_sample(const struct set *c, const struct places *to)
{
    const int usable = (c->first || movable_1(c->plan, c->before[0], c->t))
                       && (!c->plan->discrete || c->t == floor(c->t));
    c->to[0] = c->t;
    memcpy(to->y, c->y, (size_t)(NY * c->batch) * sizeof *c->y);
    for (int64_t row = 0; row < c->batch; row++) {
        double known[LU];
        if (NU && !c->u) defined_inputs(c->plan, c->batch, row, c->t, known);
        for (int i = 0; i < NU; i++)
            to->u[i * c->batch + row] = c->u ? c->u[i * c->batch + row] : known[i];
        to->left[row] = !usable || other_inputs(c->plan, c->batch, row, c->t, to->u) ? LEFT : DONE;
    }
}

/* Put a number in all lanes. */
static void everywhere(int n, const double *from, int64_t distance, lanes *restrict to)
{
    for (int i = 0; i < n; i++) EACH_LANE to[i][l] = from[i * distance];
}

/* Set the interval to the sample of a call in a row, with the numbers of its plant. */
static void set_interval(const struct set *c, const struct places *to, int64_t row, lanes *p,
                         struct interval *over)
{
    const struct places from = find_places(c->before, c->batch, c->members);
    const int64_t own = c->plan->p_rows;
    everywhere(NP, c->plan->p + (own ? row : 0), own ? c->batch : 1, p);
    over->plan = c->plan;
    over->p = (const lanes *)p;
    over->t0 = c->before[0];
    over->t1 = c->t;
    everywhere(NU, from.u + row, c->batch, over->u0);
    everywhere(NU, to->u + row, c->batch, over->u1);
}

/* Forces L w of a step: white noise projected on linear functions of time. ``drawn`` (2 m, members)
   are normal numbers. */
static inline void forces(const struct plan *plan, double h, const double *drawn, int64_t members,
                          int64_t at, int count, lanes (*restrict force)[NX])
{
    const double root = sqrt(h);
    for (int i = 0; i < 3 * NX; i++) EACH_LANE force[0][i][l] = 0;
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

/* Outputs y (NY, members) of points x (NX, members); those that are missing are zero. */
static void find_outputs(const struct interval *over, const double *given, int64_t batch,
                         int64_t members, const double *x, double *y)
{
    lanes t;
    EACH_LANE t[l] = over->t1;
    for (int64_t at = 0; at < members; at += W) {
        const int count = (int)MIN(members - at, W);
        lanes point[NX], output[NY];
        AT_WIDTH(load)(NX, x, members, at, count, point);
        AT_WIDTH(plant_h)((const double *)t, (const lanes *)point, over->u1, over->p, output);
        for (int i = 0; i < NY; i++)
            if (given[i * batch] != given[i * batch]) EACH_LANE output[i][l] = 0;
        AT_WIDTH(store)(NY, (const lanes *)output, y, members, at, count);
    }
}

/* The sum of w a over the members */
static double weighted_sum(int64_t members, const double *restrict w, const double *restrict a)
{
    double part[W] = {0}, sum = 0;
    int64_t k = 0;
    for (; k + W <= members; k += W) EACH_LANE part[l] += w[k + l] * a[k + l];
    for (int l = 0; k + l < members; l++) part[l] += w[k + l] * a[k + l];
    EACH_LANE sum += part[l];
    return sum;
}

/* The sum of w (a - mean_a) (b - mean_b) over the members */
static double weighted_product(int64_t members, const double *restrict w, const double *a,
                               double mean_a, const double *b, double mean_b)
{
    double part[W] = {0}, sum = 0;
    int64_t k = 0;
    for (; k + W <= members; k += W)
        EACH_LANE part[l] += w[k + l] * (a[k + l] - mean_a) * (b[k + l] - mean_b);
    for (int l = 0; k + l < members; l++)
        part[l] += w[k + l] * (a[k + l] - mean_a) * (b[k + l] - mean_b);
    EACH_LANE sum += part[l];
    return sum;
}

/* Means (n,) of points (n, members) with weights that have the sum ``whole`` */
static void find_means(int n, int64_t members, const double *w, double whole, const double *points,
                       double *mean)
{
    for (int i = 0; i < n; i++)
        mean[i] = weighted_sum(members, w, points + i * members) / whole;
}

/* Their covariances C (n, n), for the divisor ``whole`` */
static void find_covariances(int n, int64_t members, const double *w, double whole,
                             const double *points, const double *mean, double *C)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++)
            C[i * n + j] = C[j * n + i] =
                weighted_product(members, w, points + i * members, mean[i], points + j * members,
                                 mean[j]) / whole;
}

/* Move components of points (n, members) that repeat to within half a period of their circular
   mean, as pinnobs_gym/estimation/circular.py says. */
static void gather(int n, const double *periods, int64_t members, const double *w, double *points)
{
    for (int i = 0; periods && i < n; i++) {
        const double period = periods[i], unit = 2 * acos(-1.0) / period;
        double *const x = points + i * members, first = isfinite(x[0]) ? x[0] : 0;
        double sine = 0, cosine = 0;
        if (!period) continue;
        for (int64_t k = 0; k < members; k++) {
            const double angle = unit * (x[k] - first);
            if (!isfinite(angle)) continue;
            sine += w[k] * sin(angle);
            cosine += w[k] * cos(angle);
        }
        const double centre = first + atan2(sine, cosine) / unit;
        for (int64_t k = 0; k < members; k++) x[k] = nearest(x[k], centre, period);
    }
}

/* 1 if a state of the points x (NX, members) is outside of its bounds */
static int any_outside(const struct plan *plan, int64_t members, const double *x)
{
    int found = 0;
    for (int i = 0; plan->low && i < NX; i++)
        for (int64_t k = 0; k < members; k++)
            found |= (x[i * members + k] < plan->low[i]) | (x[i * members + k] > plan->high[i]);
    return found;
}

static int all_finite(int64_t n, const double *a)
{
    int finite = 1;
    for (int64_t i = 0; i < n; i++) finite &= isfinite(a[i]) != 0;
    return finite;
}

/* Covariance R (NY, NY) of the noise of a row, where missing outputs do not count with others */
static void load_noise(const struct set *c, int64_t row, lanes_1 *R)
{
    const int64_t own = c->plan->R_rows;
    lanes_1 y[NY];
    load_1(NY, c->y, c->batch, row, 1, y);
    load_1(NY * NY, c->plan->R, own ? c->batch : 0, row, 1, R);
    leave_out_missing_1((const lanes_1 *)y, R);
}

/* Innovations e (NY,) of predictions yhat in a row, zero where an output is missing */
static void find_innovations(const struct set *c, int64_t row, const double *yhat, double *e)
{
    for (int i = 0; i < NY; i++) {
        const double y = c->y[i * c->batch + row];
        e[i] = y - yhat[i];
        if (c->plan->output_period && c->plan->output_period[i])
            e[i] = wrapped(e[i], c->plan->output_period[i]);
        if (y != y) e[i] = 0;
    }
}

/* 1 where pinnobs_gym/estimation/wrapping.py may have to say something of angles, of predictions x
   with covariances P (NX, NX): an output is not linear in an uncertain state that repeats, if
   ``states``, or its own turn is not certain */
static int may_turn(const struct set *c, const struct interval *over, int64_t row, int states,
                    const double *x, const double *P, const lanes_1 *R)
{
    const struct plan *plan = c->plan;
    double t[1] = {over->t1};
    lanes_1 x1[NX], P1[NX * NX], u[LU], p[LP], h[NY], H[NY * NX], HP[NY * NX], S[NY * NY];
    int64_t bad[1] = {0};
    if (!plan->output_period && !(states && plan->state_period)) return 0;
    for (int i = 0; i < NX; i++) x1[i][0] = x[i];
    for (int i = 0; i < NX * NX; i++) P1[i][0] = states ? P[i] : 0;
    for (int i = 0; i < NU; i++) u[i][0] = over->u1[i][0];
    for (int i = 0; i < NP; i++) p[i][0] = over->p[i][0];
    plant_h_linearised_1(t, (const lanes_1 *)x1, (const lanes_1 *)u, (const lanes_1 *)p, h, H);
    for (int i = 0; i < NY; i++)
        for (int j = 0; isnan(c->y[i * c->batch + row]) && j < NX; j++) H[i * NX + j][0] = 0;
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NX; j++) {
            HP[i * NX + j][0] = 0;
            for (int k = 0; k < NX; k++) HP[i * NX + j][0] += H[i * NX + k][0] * P[k * NX + j];
        }
    symmetric_1(NY, NX, (const lanes_1 *)HP, (const lanes_1 *)H, S);
    for (int i = 0; i < NY * NY; i++) S[i][0] += R[i][0];
    mark_wide_1(plan, (const lanes_1 *)P1, (const lanes_1 *)S, bad);
    return bad[0] != 0;
}

/* Copy normal numbers (number, members, n) to (number, n, members). */
static void transpose(int64_t number, int64_t members, int64_t n, const double *from, double *to)
{
    for (int64_t s = 0; s < number; s++, from += members * n, to += members * n)
        for (int64_t k = 0; k < members; k++)
            for (int64_t i = 0; i < n; i++) to[i * members + k] = from[k * n + i];
}
