/* The entries: rows in groups of WIDE lanes, or one by one if they are few. */
#include <stdlib.h>

/* Number of parts of an interval whose numbers of steps lie on the stack */
#define FEW 64

static int64_t most(double length, double longest)
{
    const double count = ceil(length / longest - 1e-6);
    return count < 1 ? 1 : (int64_t)count;
}

/* Find the parts of an interval. */
static void find_parts(const struct moved *c, struct parts *parts)
{
    const struct model *model = c->model;
    const int64_t rows = c->t0_rows ? c->batch : 1;
    double first = INFINITY, last = -INFINITY;
    for (int64_t r = 0; r < rows; r++) {
        first = MIN(first, c->t0_rows ? c->t0_rows[r] : c->t0);
        last = -MIN(-last, -(c->t1_rows ? c->t1_rows[r] : c->t1));
    }
    parts->first = 0;
    while (parts->first < model->num_breaks && model->breaks[parts->first] <= first) parts->first++;
    parts->number = 1;
    while (parts->first + parts->number - 1 < model->num_breaks
           && model->breaks[parts->first + parts->number - 1] < last)
        parts->number++;
}

/* The number of steps of a part, which is that of the row in which it is longest */
static int64_t steps_of_part(const struct moved *c, const struct parts *parts, int64_t q)
{
    const double *after = c->model->breaks + parts->first + q;
    double longest = 0;
    for (int64_t r = 0; r < (c->t0_rows ? c->batch : 1); r++) {
        const double t0 = c->t0_rows ? c->t0_rows[r] : c->t0;
        const double t1 = c->t1_rows ? c->t1_rows[r] : c->t1;
        const double start = q ? within(after[-1], t0, t1) : t0;
        const double end = q < parts->number - 1 ? within(after[0], t0, t1) : t1;
        longest = maximum(longest, end - start);
    }
    return most(longest, c->model->longest);
}

/* The number of steps of an interval */
int64_t steps(const struct moved *c)
{
    int64_t sum = 0;
    struct parts parts;
    if (c->model->discrete) return c->t1 > c->t0 ? (int64_t)(c->t1 - c->t0) : 0;
    find_parts(c, &parts);
    for (int64_t q = 0; q < parts.number; q++) sum += steps_of_part(c, &parts, q);
    return sum;
}

/* Move the states. With F and Q, these are those of the first point. */
void move(const struct moved *c)
{
    int64_t few[FEW], *count = few;
    struct parts parts;
    find_parts(c, &parts);
    if (parts.number > FEW) count = malloc((size_t)parts.number * sizeof *count);
    for (int64_t q = 0; q < parts.number; q++) count[q] = steps_of_part(c, &parts, q);
    parts.count = count;
    for (int64_t row = 0, stop; row < c->points * c->batch;) {
        const int linearised = c->F && row < c->batch;
        stop = linearised ? c->batch : c->points * c->batch;
        const int64_t rest = stop - row;
        const int taken = rest < 3 ? 1 : (int)MIN(rest, WIDE);
        if (linearised) {
            if (taken == 1) linearise_rows_1(c, &parts, row, 1);
            else LINEARISE_WIDE(c, &parts, row, taken);
        } else {
            if (taken == 1) step_rows_1(c, &parts, row, 1);
            else STEP_WIDE(c, &parts, row, taken);
        }
        row += taken;
    }
    if (count != few) free(count);
}
