/* Steps of the model from one sample to the next, as pinnobs_gym/simulation/model.py says. Rows may
   have times of their own; all take the same number of Runge-Kutta steps. */

#ifndef MODEL
#define MODEL
struct model {
    const double *p;          /* the plant's numbers, (NP, 1 or batch) */
    int64_t p_rows;           /* 1, or 0 if p is the same in all rows */
    double longest;           /* longest Runge-Kutta step in s */
    const double *breaks;     /* ascending times at which f jumps */
    int64_t num_breaks;
    int64_t input;            /* 0: defined by the plant, 1: measured and held, 2: joined */
    int64_t discrete;         /* 1 if the plant is a map */
};
/* States (points, batch, n) and inputs (points, batch, NU). Distances are in doubles. */
struct moved {
    const struct model *model;
    int64_t points, batch;
    double t0, t1;            /* in s, unless there are rows' own times (batch,) */
    const double *t0_rows, *t1_rows;
    const double *x;
    int64_t x_point, x_row, x_state;
    const double *u0, *u1;
    int64_t u_point, u_row, u_input;
    double *end;              /* states at the end */
    int64_t end_point, end_row, end_state;
    const double *L;          /* process noise, (NX, m) */
    int64_t m;
    const double *draws;      /* standard normal numbers (steps, points, batch, m or 2 m), or NULL */
    int64_t draws_step, draws_point, draws_row;
    double *F, *Q;            /* (NX, NX, batch) */
    const double *low, *high; /* bounds (NX,) of states with drawn noise, or NULL */
};
/* The parts of an interval between the times at which f jumps: ``count`` steps in each */
struct parts {
    int64_t first, number;    /* the part after ``first`` breakpoints, and the number of parts */
    const int64_t *count;
};
#define SMALLEST 2.2250738585072014e-308
static inline double within(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}
#endif

/* W rows of a call, of which ``count`` exist; a row is a point of an episode. */
#define group AT_WIDTH(group)
struct group {
    const struct moved *c;
    int64_t row, count;
    int64_t point[W], episode[W];
    lanes t0, t1, p[LP];
    /* a step: its length, and the times and inputs at its start, middle and end */
    lanes h, t[3], u[3][LU];
};

static void AT_WIDTH(begin)(const struct moved *c, int64_t row, int64_t count, struct group *g,
                            lanes *restrict x)
{
    const struct model *model = c->model;
    g->c = c;
    g->row = row;
    g->count = count;
    EACH_LANE {
        const int64_t at = row + MIN(l, count - 1);
        g->point[l] = at / c->batch;
        g->episode[l] = at % c->batch;
        g->t0[l] = c->t0_rows ? c->t0_rows[g->episode[l]] : c->t0;
        g->t1[l] = c->t1_rows ? c->t1_rows[g->episode[l]] : c->t1;
    }
    for (int i = 0; i < NP; i++)
        EACH_LANE g->p[i][l] = model->p_rows ? model->p[i * c->batch + g->episode[l]] : model->p[i];
    for (int i = 0; i < NX; i++)
        EACH_LANE x[i][l] = c->x[g->point[l] * c->x_point + g->episode[l] * c->x_row
                                 + i * c->x_state];
}

/* Inputs at times (W) of the interval */
static void AT_WIDTH(inputs)(const struct group *g, const double *restrict t, lanes *restrict u)
{
    const struct moved *c = g->c;
    if (c->model->input) {
        EACH_LANE {
            const int64_t at = g->point[l] * c->u_point + g->episode[l] * c->u_row;
            const double whole = maximum(g->t1[l] - g->t0[l], SMALLEST);
            const double part = c->model->input == 1 ? 0 : (t[l] - g->t0[l]) / whole;
            for (int i = 0; i < NU; i++) {
                const double before = c->u0[at + i * c->u_input];
                u[i][l] = c->model->input == 1
                    ? before : (1 - part) * before + part * c->u1[at + i * c->u_input];
            }
        }
    } else if (NU && (c->model->p_rows || c->t0_rows)) {
        EACH_LANE plant_input(t[l], &g->p[0][l], W, &u[0][l], W);
    } else if (NU) { /* the same in all lanes */
        plant_input(t[0], &g->p[0][0], W, &u[0][0], W);
        for (int i = 0; i < NU; i++)
            for (int l = 1; l < W; l++) u[i][l] = u[i][0];
    }
}

/* Set step k of a part: its length, and its times and inputs. */
static void AT_WIDTH(set_step)(struct group *g, const struct parts *parts, int64_t part, int64_t k)
{
    const struct model *model = g->c->model;
    const double *after = model->breaks + parts->first + part;
    lanes start, end, last;
    EACH_LANE {
        start[l] = part ? within(after[-1], g->t0[l], g->t1[l]) : g->t0[l];
        end[l] = part < parts->number - 1 ? within(after[0], g->t0[l], g->t1[l]) : g->t1[l];
        last[l] = INFINITY; /* at its end, a part has the left limit of what jumps there */
        for (int64_t b = 0; b < model->num_breaks; b++)
            if (model->breaks[b] == end[l] && end[l] > start[l])
                last[l] = nextafter(end[l], start[l]);
        g->h[l] = (end[l] - start[l]) / parts->count[part];
    }
    for (int i = 0; i < 3; i++) {
        EACH_LANE g->t[i][l] = minimum(start[l] + (k + 0.5 * i) * g->h[l], last[l]);
        if (i == 0 && k > 0) memcpy(g->u[0], g->u[2], sizeof g->u[0]);
        else AT_WIDTH(inputs)(g, g->t[i], g->u[i]);
    }
}

/* Forces L w of a step with the given number: white noise projected on linear functions of time */
static void AT_WIDTH(forces)(const struct group *g, int64_t number, lanes (*restrict force)[NX])
{
    const struct moved *c = g->c;
    memset(force, 0, 3 * sizeof *force);
    for (int64_t j = 0; j < c->m; j++)
        EACH_LANE {
            const double *drawn = c->draws + number * c->draws_step
                                + g->point[l] * c->draws_point + g->episode[l] * c->draws_row;
            const double root = sqrt(g->h[l]);
            const double even = drawn[j] / root, odd = drawn[c->m + j] / root;
            const double w[3] = {even - sqrt(3.0) * odd, even, even + sqrt(3.0) * odd};
            for (int q = 0; q < 3; q++)
                for (int i = 0; i < NX; i++) force[q][i][l] += w[q] * c->L[i * c->m + j];
        }
}

/* x at the end of a step by the classical Runge-Kutta method, from x at its start */
static void AT_WIDTH(runge_kutta)(const struct group *g, lanes (*restrict force)[NX],
                                  lanes *restrict x)
{
    lanes k[4][NX], point[NX];
    const double part[4] = {0, 0.5, 0.5, 1};
    for (int q = 0; q < 4; q++) {
        const int at = (q + 1) / 2; /* the start, twice the middle, the end */
        for (int i = 0; i < NX; i++)
            EACH_LANE point[i][l] = q ? part[q] * g->h[l] * k[q - 1][i][l] + x[i][l] : x[i][l];
        AT_WIDTH(plant_f)(g->t[at], point, g->u[at], g->p, k[q]);
        if (force)
            for (int i = 0; i < NX; i++) EACH_LANE k[q][i][l] += force[at][i][l];
    }
    for (int i = 0; i < NX; i++)
        EACH_LANE x[i][l] +=
            g->h[l] / 6 * ((k[1][i][l] + k[2][i][l]) * 2 + k[0][i][l] + k[3][i][l]);
}

/* The same, with the Jacobian F (NX, NX) of the step, and those of f at its first and last stage.
   F integrates the variational equation F' = A F by the same method at the same stages. */
static void AT_WIDTH(runge_kutta_linearised)(const struct group *g, lanes *restrict x,
                                             lanes *restrict F, lanes *restrict A_first,
                                             lanes *restrict A_last)
{
    lanes k[4][NX], point[NX], A[NX * NX], Phi[NX * NX], K[NX * NX];
    const double part[4] = {0, 0.5, 0.5, 1}, weight[4] = {1, 2, 2, 1};
    for (int q = 0; q < 4; q++) {
        const int at = (q + 1) / 2;
        for (int i = 0; i < NX; i++)
            EACH_LANE point[i][l] = q ? part[q] * g->h[l] * k[q - 1][i][l] + x[i][l] : x[i][l];
        AT_WIDTH(plant_f_linearised)(g->t[at], point, g->u[at], g->p, k[q], A);
        if (q == 0) { /* Phi = I at the start */
            memcpy(A_first, A, sizeof A);
            memcpy(K, A, sizeof A);
            memcpy(F, A, sizeof A);
            continue;
        }
        if (q == 3) memcpy(A_last, A, sizeof A);
        for (int i = 0; i < NX * NX; i++) EACH_LANE Phi[i][l] = part[q] * g->h[l] * K[i][l];
        for (int i = 0; i < NX; i++) EACH_LANE Phi[i * NX + i][l] += 1;
        AT_WIDTH(product)(NX, NX, NX, A, Phi, K);
        for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] += weight[q] * K[i][l];
    }
    for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] *= g->h[l] / 6;
    for (int i = 0; i < NX; i++) EACH_LANE F[i * NX + i][l] += 1;
    for (int i = 0; i < NX; i++)
        EACH_LANE x[i][l] +=
            g->h[l] / 6 * ((k[1][i][l] + k[2][i][l]) * 2 + k[0][i][l] + k[3][i][l]);
}

/* Q = Q + B L L^T B^T w for B (NX, NX), the identity if NULL, and w in each lane */
static void AT_WIDTH(add_noise)(const struct moved *c, const lanes *restrict B,
                                const double *restrict w, lanes *restrict Q)
{
    for (int64_t j = 0; j < c->m; j++) {
        lanes BL[NX];
        for (int i = 0; i < NX; i++) {
            EACH_LANE BL[i][l] = B ? 0 : c->L[i * c->m + j];
            for (int n = 0; B && n < NX; n++) {
                const double entry = c->L[n * c->m + j];
                if (entry != 0) EACH_LANE BL[i][l] += B[i * NX + n][l] * entry;
            }
        }
        for (int i = 0; i < NX; i++)
            for (int n = 0; n < NX; n++) EACH_LANE Q[i * NX + n][l] += w[l] * (BL[i][l] * BL[n][l]);
    }
}

/* Add to Q the noise of a step with Jacobian F, by Simpson's rule. Psi at the middle is the cubic
   Hermite polynomial through its values and slopes -Psi A at the ends; this is twice that. */
static void AT_WIDTH(noise_of_step)(const struct group *g, const lanes *restrict F,
                                    const lanes *restrict A_first, const lanes *restrict A_last,
                                    lanes *restrict Q)
{
    lanes twice[NX * NX], w;
    AT_WIDTH(product)(NX, NX, NX, F, A_first, twice);
    for (int i = 0; i < NX * NX; i++)
        EACH_LANE twice[i][l] = (A_last[i][l] - twice[i][l]) * (g->h[l] / 4) + F[i][l];
    for (int i = 0; i < NX; i++) EACH_LANE twice[i * NX + i][l] += 1;
    EACH_LANE w[l] = g->h[l] / 6;
    AT_WIDTH(add_noise)(g->c, F, w, Q);
    AT_WIDTH(add_noise)(g->c, twice, w, Q);
    AT_WIDTH(add_noise)(g->c, NULL, w, Q);
}

/* Set the time and inputs of step k of a map, from the number of the first. Return whether any row
   takes it; the others keep their state. */
static int AT_WIDTH(set_map_step)(struct group *g, int64_t k, int64_t *restrict going)
{
    int any = 0;
    EACH_LANE g->t[0][l] = g->t0[l] + k;
    EACH_LANE any |= going[l] = g->t[0][l] < g->t1[l];
    if (any) AT_WIDTH(inputs)(g, g->t[0], g->u[0]);
    return any;
}

static void AT_WIDTH(finish)(const struct group *g, const lanes *restrict x)
{
    const struct moved *c = g->c;
    for (int l = 0; l < g->count; l++)
        for (int i = 0; i < NX; i++)
            c->end[g->point[l] * c->end_point + g->episode[l] * c->end_row + i * c->end_state] =
                x[i][l];
}

/* Move states that noise moved beyond a bound to that bound. */
static void AT_WIDTH(absorb)(const struct moved *c, lanes *restrict x)
{
    for (int i = 0; i < NX; i++) EACH_LANE x[i][l] = absorbed(x[i][l], c->low[i], c->high[i]);
}

/* Move the states of W rows. */
static void AT_WIDTH(step_rows)(const struct moved *c, const struct parts *parts, int64_t row,
                                int count)
{
    struct group g;
    lanes x[NX], next[NX], force[3][NX];
    int64_t going[W], number = 0;
    AT_WIDTH(begin)(c, row, count, &g, x);
    if (c->model->discrete) {
        for (; AT_WIDTH(set_map_step)(&g, number, going); number++) {
            AT_WIDTH(plant_f)(g.t[0], x, g.u[0], g.p, next);
            for (int64_t j = 0; c->draws && j < c->m; j++)
                EACH_LANE {
                    const double w = c->draws[number * c->draws_step + g.point[l] * c->draws_point
                                              + g.episode[l] * c->draws_row + j];
                    for (int i = 0; i < NX; i++) next[i][l] += c->L[i * c->m + j] * w;
                }
            if (c->low) AT_WIDTH(absorb)(c, next);
            for (int i = 0; i < NX; i++) EACH_LANE x[i][l] = going[l] ? next[i][l] : x[i][l];
        }
    } else {
        for (int64_t part = 0; part < parts->number; part++)
            for (int64_t k = 0; k < parts->count[part]; k++, number++) {
                AT_WIDTH(set_step)(&g, parts, part, k);
                if (c->draws) AT_WIDTH(forces)(&g, number, force);
                AT_WIDTH(runge_kutta)(&g, c->draws ? force : NULL, x);
                if (c->low) AT_WIDTH(absorb)(c, x);
            }
    }
    AT_WIDTH(finish)(&g, x);
}

/* The same, with the Jacobian F and the covariance Q of the process noise. */
static void AT_WIDTH(linearise_rows)(const struct moved *c, const struct parts *parts, int64_t row,
                                     int count)
{
    struct group g;
    lanes x[NX], F[NX * NX], Q[NX * NX], A_first[NX * NX], A_last[NX * NX], step[NX * NX];
    AT_WIDTH(begin)(c, row, count, &g, x);
    for (int i = 0; i < NX * NX; i++) EACH_LANE F[i][l] = i % (NX + 1) == 0;
    for (int i = 0; i < NX * NX; i++) EACH_LANE Q[i][l] = 0;
    if (c->model->discrete) {
        lanes next[NX], one;
        int64_t going[W];
        EACH_LANE one[l] = 1;
        for (int64_t k = 0; AT_WIDTH(set_map_step)(&g, k, going); k++) {
            AT_WIDTH(plant_f_linearised)(g.t[0], x, g.u[0], g.p, next, A_first);
            AT_WIDTH(product)(NX, NX, NX, A_first, F, step);
            memcpy(A_last, Q, sizeof Q);
            AT_WIDTH(sandwich)(NX, A_first, A_last);
            AT_WIDTH(add_noise)(c, NULL, one, A_last);
            for (int i = 0; i < NX; i++) EACH_LANE x[i][l] = going[l] ? next[i][l] : x[i][l];
            for (int i = 0; i < NX * NX; i++) {
                EACH_LANE F[i][l] = going[l] ? step[i][l] : F[i][l];
                EACH_LANE Q[i][l] = going[l] ? A_last[i][l] : Q[i][l];
            }
        }
    } else {
        int first = 1;
        for (int64_t part = 0; part < parts->number; part++)
            for (int64_t k = 0; k < parts->count[part]; k++) {
                AT_WIDTH(set_step)(&g, parts, part, k);
                AT_WIDTH(runge_kutta_linearised)(&g, x, step, A_first, A_last);
                if (c->m) {
                    if (!first) AT_WIDTH(sandwich)(NX, step, Q);
                    AT_WIDTH(noise_of_step)(&g, step, A_first, A_last, Q);
                }
                if (first) memcpy(F, step, sizeof F);
                else { /* the chain rule over the steps */
                    AT_WIDTH(product)(NX, NX, NX, step, F, A_first);
                    memcpy(F, A_first, sizeof F);
                }
                first = 0;
            }
    }
    AT_WIDTH(finish)(&g, x);
    AT_WIDTH(store)(NX * NX, F, c->F, c->batch, row, count);
    if (c->m) AT_WIDTH(store)(NX * NX, Q, c->Q, c->batch, row, count);
}
#undef group
