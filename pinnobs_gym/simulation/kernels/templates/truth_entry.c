/* The entry: solve the rows in groups of WIDE lanes, or one by one if they are few. */
void solve(const struct solution *s)
{
    for (int64_t row = 0; row < s->batch;) {
        const int64_t rest = s->batch - row;
        const int count = rest < 3 ? 1 : (int)MIN(rest, WIDE);
        if (count == 1) solve_rows_1(s, row, 1);
        else SOLVE_WIDE(s, row, count);
        row += count;
    }
}
