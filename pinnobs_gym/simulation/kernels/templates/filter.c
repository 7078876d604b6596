/* The entry: filter the rows in groups of WIDE lanes, or one by one if they are few. ``reached``
   (batch,) is set to the number of the sample that NumPy has to do in each row, or the number of
   samples. Returns 0 if there is none to do. */
int64_t run(const struct call *c, int64_t *reached)
{
    int64_t left = 0;
    for (int64_t row = 0; row < c->batch;) {
        const int64_t rest = c->batch - row;
        const int count = rest < 3 ? 1 : (int)MIN(rest, WIDE);
        const int64_t k = count == 1 ? filter_rows_1(c, row, 1) : FILTER_WIDE(c, row, count);
        for (int l = 0; l < count; l++) reached[row + l] = k;
        left |= k < c->samples;
        row += count;
    }
    return left;
}
