void @name@_init(@name@ *filter, const @real@ *xhat0)
{
    memset(filter, 0, sizeof *filter);
    memcpy(filter->x, xhat0 ? xhat0 : prior_mean, sizeof filter->x);
}

/* Move x by the model, and correct it by one linearised step of Euler's implicit method for
   x' = L (y - h(t, x, u)), over the time w since each output's last sample:
   x + K (y - h) with K = L w (I + H L w)^-1. Return 0 if that fails. */
static int advance(@name@ *filter, struct sample *now, seconds t)
{
    real H[NY * NX], K[NX * NY], M[NY * NY], h[NY];
    if (filter->samples) {
        const struct interval over = interval_to(filter, now, t);
        move(&over, filter->x);
    }
    plant_h_linearised(now->t, filter->x, now->u, plan.p, h, H);
    for (int j = 0; j < NY; j++) {
        const int missing = now->y[j] != now->y[j];
        const real since = filter->samples ? (real)(t - filter->last[j]) : 0;
        const real e = now->y[j] - h[j];
        now->e[j] = missing ? 0 : plan.output_period && plan.output_period[j]
                  ? wrapped(e, plan.output_period[j]) : e;
        for (int i = 0; i < NX; i++) K[i * NY + j] = missing ? 0 : gain[i * NY + j] * since;
        if (!missing || !filter->samples) filter->last[j] = t;
    }
    for (int i = 0; i < NY; i++)
        for (int j = 0; j < NY; j++) {
            M[i * NY + j] = i == j;
            for (int k = 0; k < NX; k++) M[i * NY + j] += H[i * NX + k] * K[k * NY + j];
        }
    right_divide(NX, NY, K, M);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NY; j++) filter->x[i] += K[i * NY + j] * now->e[j];
    for (int i = 0; plan.low && i < NX; i++)
        filter->x[i] = absorbed(filter->x[i], plan.low[i], plan.high[i]);
    memcpy(filter->innovation, now->e, sizeof filter->innovation);
    return 1;
}

