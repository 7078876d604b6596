/* Between the rows of a call, which are the last axis of its arrays, and lanes. */

/* Copy W rows, of which the first ``count`` exist, of an array (n, rows or 1) into lanes. The last
   row stands for those that do not exist. */
SEPARATE void AT_WIDTH(load)(int64_t n, const double *restrict from, int64_t rows, int64_t row,
                             int count, lanes *restrict to)
{
    if (rows == 0) {
        for (int64_t i = 0; i < n; i++) EACH_LANE to[i][l] = from[i];
    } else if (count == W) {
        for (int64_t i = 0; i < n; i++) EACH_LANE to[i][l] = from[i * rows + row + l];
    } else if (count == 1) {
        for (int64_t i = 0; i < n; i++) EACH_LANE to[i][l] = from[i * rows + row];
    } else {
        for (int64_t i = 0; i < n; i++)
            EACH_LANE to[i][l] = from[i * rows + row + MIN(l, count - 1)];
    }
}

/* Copy the lanes that exist into W rows of an array (n, rows). */
SEPARATE void AT_WIDTH(store)(int64_t n, const lanes *restrict from, double *restrict to,
                              int64_t rows, int64_t row, int count)
{
    if (count == W) {
        for (int64_t i = 0; i < n; i++) EACH_LANE to[i * rows + row + l] = from[i][l];
    } else if (count == 1) {
        for (int64_t i = 0; i < n; i++) to[i * rows + row] = from[i][0];
    } else {
        for (int64_t i = 0; i < n; i++)
            for (int l = 0; l < count; l++) to[i * rows + row + l] = from[i][l];
    }
}
