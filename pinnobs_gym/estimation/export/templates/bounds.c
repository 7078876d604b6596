/* Largest violation of a bound that is left to rounding, relative to the largest one */
#define ROUNDING (sizeof(real) == sizeof(double) ? 1e-10 : 1e-5)
/* Share of a component's variance that is left, given those at their bounds, below which it cannot be
   moved apart from these */
#define DEPENDENT (sizeof(real) == sizeof(double) ? 1e-12 : 1e-6)

/* Find by how much the multipliers r of the components at their bounds shrink per unit of that of
   component p, by elimination in the correlation matrix C. Return the variance of p that is left
   given these components. */
static real response(const real *C, const int *side, int p, real *r)
{
    real A[NX * (NX + 1)];
    for (int i = 0; i < NX; i++) {
        for (int j = 0; j < NX; j++)
            A[i * (NX + 1) + j] = side[i] && side[j] ? C[i * NX + j] : i == j;
        A[i * (NX + 1) + NX] = side[i] ? C[i * NX + p] : 0;
    }
    for (int i = 0; i < NX; i++)
        for (int k = i + 1; k < NX; k++) {
            const real factor = A[k * (NX + 1) + i] / A[i * (NX + 1) + i];
            for (int j = i; j <= NX; j++) A[k * (NX + 1) + j] -= factor * A[i * (NX + 1) + j];
        }
    real left = C[p * NX + p];
    for (int i = NX - 1; i >= 0; i--) {
        r[i] = A[i * (NX + 1) + NX];
        for (int j = i + 1; j < NX; j++) r[i] -= A[i * (NX + 1) + j] * r[j];
        r[i] /= A[i * (NX + 1) + i];
    }
    for (int i = 0; i < NX; i++)
        if (side[i]) left -= C[i * NX + p] * r[i];
    return left;
}

/* Move x to the most probable point within the bounds of the states, that with the least
   (x' - x)^T P^-1 (x' - x): the dual method of Goldfarb and Idnani (1983) for bounds. It begins with
   the point without bounds and brings the component that is furthest beyond its bound to it, step by
   step; its multiplier grows until it is there, or until that of another one, which gives way, is
   zero. */
static void keep_inside(const struct plan *plan, const real *P, real *x)
{
    real std[NX], C[NX * NX], low[NX], high[NX], force[NX], r[NX], tolerance = 1, moved[NX];
    int side[NX], movable[NX], pending = -1, outside = 0;
    for (int i = 0; i < NX; i++) outside |= x[i] < plan->low[i] || x[i] > plan->high[i];
    if (!outside) return;
    for (int i = 0; i < NX; i++) {
        std[i] = P[i * NX + i] > 0 ? sqrt(P[i * NX + i]) : 1;
        movable[i] = P[i * NX + i] > 0 && (isfinite(plan->low[i]) || isfinite(plan->high[i]));
        side[i] = 0;
        force[i] = 0;
        low[i] = (plan->low[i] - x[i]) / std[i];
        high[i] = (plan->high[i] - x[i]) / std[i];
        tolerance = maximum(tolerance, maximum(low[i], -high[i]));
    }
    tolerance *= (real)ROUNDING;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) C[i * NX + j] = P[i * NX + j] / (std[i] * std[j]);
    for (int round = 0; round < 10 * NX; round++) {
        int p = pending, first = -1;
        real d[NX], worst = -INFINITY, size = INFINITY;
        for (int i = 0; i < NX; i++) {
            d[i] = 0;
            for (int j = 0; j < NX; j++) d[i] -= C[i * NX + j] * force[j];
            const real excess = maximum(low[i] - d[i], d[i] - high[i]);
            if (pending < 0 && movable[i] && !side[i] && excess > worst) p = i, worst = excess;
        }
        if (p < 0 || (pending < 0 && !(worst > tolerance))) break;
        const int upper = d[p] > high[p], towards = upper ? 1 : -1;
        const real excess = maximum(low[p] - d[p], d[p] - high[p]);
        const real left = response(C, side, p, r);
        const real whole = left > (real)DEPENDENT ? excess / left : INFINITY;
        for (int i = 0; i < NX; i++)
            if (side[i] * towards * r[i] > 0 && fabs(force[i]) / fabs(r[i]) < size)
                size = fabs(force[i]) / fabs(r[i]), first = i;
        const real step = minimum(whole, size);
        if (!isfinite(step)) { /* it cannot be moved apart from the others */
            movable[p] = 0;
            pending = -1;
            continue;
        }
        for (int i = 0; i < NX; i++) force[i] -= towards * step * r[i];
        force[p] += towards * step;
        if (whole <= size) {
            side[p] = towards;
            pending = -1;
        } else { /* another one leaves its bound first */
            side[first] = 0;
            force[first] = 0;
            pending = p;
        }
    }
    for (int i = 0; i < NX; i++) {
        moved[i] = 0;
        for (int j = 0; j < NX; j++) moved[i] += P[i * NX + j] * (force[j] / std[j]);
    }
    for (int i = 0; i < NX; i++) {
        if (isfinite(moved[i])) x[i] -= moved[i];
        x[i] = absorbed(x[i], plan->low[i], plan->high[i]);
    }
}

static void after_correction(const struct plan *plan, real *x, const real *P)
{
    keep_inside(plan, P, x);
}
