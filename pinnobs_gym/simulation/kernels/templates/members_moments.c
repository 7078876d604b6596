/* Sums over sets of points, in an order that does not depend on other rows. */

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
