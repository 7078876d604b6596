/* An interval from one sample to the next, and its steps. */

/* An interval between two samples, for W lanes. */
#define interval AT_WIDTH(interval)
struct interval {
    const struct plan *plan;
    const lanes *p;
    seconds t0, t1;
    lanes u0[LU], u1[LU];     /* measured inputs at both */
};

/* Inputs at a time of the interval, for all lanes. */
static inline void AT_WIDTH(input_at)(const struct interval *over, seconds t, double part,
                                      lanes *restrict u)
{
    if (over->plan->input == 1) {
        for (int i = 0; i < NU; i++) EACH_LANE u[i][l] = over->u0[i][l];
    } else if (over->plan->input == 2) {
        for (int i = 0; i < NU; i++)
            EACH_LANE u[i][l] = (1 - part) * over->u0[i][l] + part * over->u1[i][l];
    } else {
        AT_WIDTH(known_input)(over->plan, over->p, t, u);
    }
}

static inline void AT_WIDTH(set_step)(const struct interval *over, seconds start, seconds step,
                                      int64_t k, seconds last, struct rk_step *s)
{
    s->h = step;
    for (int i = 0; i < 3; i++) {
        const seconds t = MIN(start + (k + 0.5 * i) * step, last);
        const seconds whole = over->t1 - over->t0;
        EACH_LANE s->t[i][l] = t;
        if (i == 0 && k > 0 && last == INFINITY) { /* the end of the previous step */
            memcpy(s->u[0], s->u[2], sizeof s->u[0]);
            continue;
        }
        AT_WIDTH(input_at)(over, t, (t - over->t0) / whole, s->u[i]);
    }
}

/* The steps of an interval. Runge-Kutta steps are equal, at most the longest, and none crosses a
   breakpoint; at its end, a part has the left limit of what jumps there. */
#define steps AT_WIDTH(steps)
struct steps {
    seconds start, end, step, last;
    int64_t count, k, next_break;
    int begun;
};

/* Go on to the next step. Return 0 if there is none. */
static inline int AT_WIDTH(locate_step)(const struct interval *over, struct steps *at)
{
    const struct plan *plan = over->plan;
    while (!at->begun || at->k == at->count) {
        if (at->begun && at->end >= over->t1) return 0;
        at->start = at->begun ? at->end : over->t0;
        if (!at->begun) at->next_break = 0;
        while (at->next_break < plan->num_breaks && plan->breaks[at->next_break] <= at->start)
            at->next_break++;
        at->end = over->t1;
        at->last = INFINITY;
        if (at->next_break < plan->num_breaks && plan->breaks[at->next_break] <= over->t1) {
            at->end = plan->breaks[at->next_break];
            at->last = nextafter(at->end, at->start);
        }
        const seconds count = ceil((at->end - at->start) / plan->longest - 1e-6);
        at->count = count < 1 ? 1 : (int64_t)count;
        at->step = (at->end - at->start) / at->count;
        at->k = 0;
        at->begun = 1;
    }
    at->k++;
    return 1;
}

static inline int AT_WIDTH(next_step)(const struct interval *over, struct steps *at,
                                      struct rk_step *s)
{
    if (!AT_WIDTH(locate_step)(over, at)) return 0;
    AT_WIDTH(set_step)(over, at->start, at->step, at->k - 1, at->last, s);
    return 1;
}
