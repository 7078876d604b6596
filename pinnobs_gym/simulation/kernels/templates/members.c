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
                    const double *x, const double *P)
{
    const struct plan *plan = c->plan;
    double t[1] = {over->t1};
    lanes_1 x1[NX], P1[NX * NX], u[LU], p[LP], h[NY], H[NY * NX], HP[NY * NX], S[NY * NY];
    lanes_1 R[NY * NY];
    int64_t bad[1] = {0};
    if (!plan->output_period && !(states && plan->state_period)) return 0;
    load_noise(c, row, R);
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
