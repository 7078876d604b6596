/* Tell whether z is, or was shortly before, outside of the region of its training; x is T*(z). */
static void mark_region(@name@ *filter, const real *x, seconds t)
{
    real nearest = INFINITY;
    for (int n = 0; n < POINTS; n++) {
        real sum = 0;
        for (int i = 0; i < NZ + NX; i++) {
            const real value = i < NZ ? filter->z[i] : x[i - NZ];
            const real off = (value - region_mean[i]) / region_scale[i] - region_points[n * (NZ + NX) + i];
            sum += off * off;
        }
        if (sum < nearest) nearest = sum;
    }
    if (!(sqrt(nearest) <= region_limits[0])) filter->left = t;
    filter->outside = t - filter->left <= region_limits[1];
}
