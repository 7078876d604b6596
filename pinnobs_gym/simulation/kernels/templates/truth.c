/* Dormand and Prince's method of order 8 on a given mesh, as pinnobs_gym/simulation/truth.py says. */

#ifndef SOLUTION
#define SOLUTION
#define NODES 6                /* of an interpolating polynomial */
struct solution {
    int64_t batch, steps;
    const double *p;           /* the plant's numbers, (NP, 1 or batch) */
    int64_t p_rows;            /* 1, or 0 if p is the same in all rows */
    const double *x0;          /* (batch, NX) */
    const double *step;        /* (steps,) in s */
    /* Points in time at which f is evaluated: STAGES for each step, then one for each check, then
       the end. The input at a point is given, joins those at both ends of an interval, or is the
       plant's own in each row. */
    const double *t;           /* (points,) in s */
    const double *u;           /* (points, NU), or NULL */
    const double *u_ends;      /* (intervals + 1, batch, NU), or NULL */
    const double *u_part;      /* (points,), the weight of the second end */
    const int64_t *u_interval; /* (steps,) */
    /* Samples: those numbered from bounds[k] to bounds[k + 1] - 1 follow node k. */
    double *out;               /* states at samples, and distances between these in doubles */
    int64_t out_sample, out_row, out_state;
    const int64_t *bounds;     /* (steps + 1,) */
    const int64_t *window;     /* (steps,) first node of the polynomial after node k */
    const double *weights;     /* (samples, 2 NODES) of (state, slope, ...) at its nodes, or NULL:
                                  a sample is then the state at the end of step k */
    /* Checks of the polynomial's slope midway after a node, in ascending order */
    int64_t checks;
    const int64_t *checked;    /* (checks,) node */
    const double *check;       /* (checks, 2, 2 NODES) weights in the state, and in the slope */
    const double *scale;       /* (NX,) */
    double *error;             /* (batch,) largest defect times step, relative to the size */
    double *end;               /* (batch, NX) */
    /* Process noise projected on linear functions of time, or m = 0 */
    int64_t m;
    const double *L;           /* (NX, m) */
    const double *draws;       /* (parts, 2, batch, m) */
    const int64_t *part;       /* (steps,) */
    const double *part_start, *part_length; /* (parts,) in s */
    const double *low, *high;  /* (NX,) bounds of the states after each part, or NULL */
};
#endif

/* The state of a stage, or that at the end of the step: x plus earlier slopes k. */
static inline void AT_WIDTH(state_of_stage)(int stage, const double *restrict w,
                                            const lanes *restrict x,
                                            lanes (*restrict k)[NX], lanes *restrict point)
{
#define STAGE(i, state) \
    case i: \
        for (int n = 0; n < NX; n++) EACH_LANE point[n][l] = state; \
        break;
    switch (stage) { EACH_STAGE(STAGE) }
#undef STAGE
}

/* Values (NX,) of a polynomial from states and slopes at its nodes, of which the first is given. */
static inline void AT_WIDTH(polynomial)(const double *restrict w, int64_t first,
                                        lanes (*restrict node)[2][NX], lanes *restrict value)
{
    const lanes *a = node[first % NODES][0], *b = node[(first + 1) % NODES][0],
                *c = node[(first + 2) % NODES][0], *d = node[(first + 3) % NODES][0],
                *e = node[(first + 4) % NODES][0], *f = node[(first + 5) % NODES][0];
    for (int n = 0; n < NX; n++) /* the slopes follow the states */
        EACH_LANE value[n][l] = w[0] * a[n][l] + w[1] * a[NX + n][l] + w[2] * b[n][l]
                              + w[3] * b[NX + n][l] + w[4] * c[n][l] + w[5] * c[NX + n][l]
                              + w[6] * d[n][l] + w[7] * d[NX + n][l] + w[8] * e[n][l]
                              + w[9] * e[NX + n][l] + w[10] * f[n][l] + w[11] * f[NX + n][l];
}

/* dx/dt at a point in time of a step */
static void AT_WIDTH(rate_at)(const struct solution *s, int64_t row, int count, int64_t step,
                              int64_t at, const lanes *restrict p, const lanes *restrict x,
                              lanes *restrict dx)
{
    lanes t, u[LU];
    EACH_LANE t[l] = s->t[at];
    if (s->u) {
        for (int i = 0; i < NU; i++) EACH_LANE u[i][l] = s->u[at * NU + i];
    } else if (s->u_ends) {
        const double part = s->u_part[at];
        const double *first = s->u_ends + s->u_interval[step] * s->batch * NU;
        for (int i = 0; i < NU; i++)
            EACH_LANE {
                const int64_t from = (row + MIN(l, count - 1)) * NU + i;
                u[i][l] = (1 - part) * first[from] + part * first[s->batch * NU + from];
            }
    } else if (NU) {
        EACH_LANE plant_input(s->t[at], &p[0][l], W, &u[0][l], W);
    }
    AT_WIDTH(plant_f)(t, x, u, p, dx);
}

/* dx = dx + L w at a point in time, where w joins two numbers drawn for the part of the step. */
static void AT_WIDTH(add_force)(const struct solution *s, int64_t row, int count, int64_t step,
                                double t, lanes *restrict dx)
{
    const int64_t part = s->part[step];
    const double *even = s->draws + 2 * part * s->batch * s->m, *odd = even + s->batch * s->m;
    const double length = s->part_length[part], root = sqrt(length);
    const double position = sqrt(3.0) * (2 * (t - s->part_start[part]) / length - 1);
    for (int64_t c = 0; c < s->m; c++) {
        lanes w;
        EACH_LANE {
            const int64_t at = (row + MIN(l, count - 1)) * s->m + c;
            w[l] = (even[at] + position * odd[at]) / root;
        }
        for (int n = 0; n < NX; n++) {
            const double entry = s->L[n * s->m + c];
            if (entry != 0) EACH_LANE dx[n][l] += w[l] * entry;
        }
    }
}

/* Write the samples that follow node k, and check the slope after it. */
static inline void AT_WIDTH(after_node)(const struct solution *s, int64_t row, int count, int64_t k,
                                        const lanes *restrict p,
                                        lanes (*restrict node)[2][NX],
                                        int64_t *restrict check, lanes *restrict error)
{
    lanes value[NX], slope[NX], rate[NX];
    for (int64_t i = s->bounds[k]; i < s->bounds[k + 1]; i++) {
        AT_WIDTH(polynomial)(s->weights + i * 2 * NODES, s->window[k], node, value);
        double *to = s->out + i * s->out_sample + row * s->out_row;
        for (int l = 0; l < count; l++)
            for (int n = 0; n < NX; n++) to[l * s->out_row + n * s->out_state] = value[n][l];
    }
    if (*check == s->checks || s->checked[*check] != k) return;
    const double *w = s->check + *check * 4 * NODES;
    AT_WIDTH(polynomial)(w, s->window[k], node, value);
    AT_WIDTH(polynomial)(w + 2 * NODES, s->window[k], node, slope);
    AT_WIDTH(rate_at)(s, row, count, k, STAGES * s->steps + *check, p, value, rate);
    for (int n = 0; n < NX; n++)
        EACH_LANE {
            const double size = maximum(fabs(value[n][l]), s->scale[n]);
            const double defect = fabs(slope[n][l] - rate[n][l]) / size * s->step[k];
            error[0][l] = maximum(error[0][l], defect);
        }
    *check += 1;
}

/* Solve W rows, of which ``count`` exist. */
static void AT_WIDTH(solve_rows)(const struct solution *s, int64_t row, int count)
{
    lanes p[LP], x[NX], point[NX], k[STAGES][NX], node[NODES][2][NX], error;
    double w[COEFFICIENTS], weighted = NAN;
    int64_t finished = 0, check = 0;
    AT_WIDTH(load)(NP, s->p, s->p_rows ? s->batch : 0, row, count, p);
    for (int n = 0; n < NX; n++)
        EACH_LANE x[n][l] = s->x0[(row + MIN(l, count - 1)) * NX + n];
    EACH_LANE error[l] = 0;
    for (int64_t j = 0; j < s->steps; j++) {
        if (s->step[j] != weighted) {
            weighted = s->step[j];
            for (int i = 0; i < COEFFICIENTS; i++) w[i] = weighted * coefficients[i];
        }
        for (int i = 0; i < STAGES; i++) {
            const int64_t at = j * STAGES + i;
            AT_WIDTH(state_of_stage)(i, w, x, k, point);
            AT_WIDTH(rate_at)(s, row, count, j, at, p, point, k[i]);
            if (s->m) AT_WIDTH(add_force)(s, row, count, j, s->t[at], k[i]);
        }
        if (s->weights) {
            memcpy(node[j % NODES][0], x, sizeof x);
            memcpy(node[j % NODES][1], k[0], sizeof x);
            for (; s->window[finished] + NODES - 1 <= j; finished++)
                AT_WIDTH(after_node)(s, row, count, finished, p, node,
                                     &check, &error);
        }
        AT_WIDTH(state_of_stage)(STAGES, w, x, k, point);
        memcpy(x, point, sizeof x);
        if (s->low && (j + 1 == s->steps || s->part[j + 1] != s->part[j]))
            for (int n = 0; n < NX; n++) EACH_LANE x[n][l] = absorbed(x[n][l], s->low[n], s->high[n]);
        if (!s->weights) {
            for (int64_t i = s->bounds[j]; i < s->bounds[j + 1]; i++)
                for (int l = 0; l < count; l++)
                    for (int n = 0; n < NX; n++)
                        s->out[i * s->out_sample + (row + l) * s->out_row + n * s->out_state] =
                            x[n][l];
        }
    }
    if (s->weights) { /* the last node */
        memcpy(node[s->steps % NODES][0], x, sizeof x);
        AT_WIDTH(rate_at)(s, row, count, s->steps - 1, STAGES * s->steps + s->checks, p, x,
                          node[s->steps % NODES][1]);
        for (; finished < s->steps; finished++)
            AT_WIDTH(after_node)(s, row, count, finished, p, node, &check,
                                 &error);
        for (int l = 0; l < count; l++) s->error[row + l] = error[l];
    }
    for (int l = 0; l < count; l++)
        for (int n = 0; n < NX; n++) s->end[(row + l) * NX + n] = x[n][l];
}
