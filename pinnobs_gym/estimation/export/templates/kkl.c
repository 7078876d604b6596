void @name@_init(@name@ *filter, const @real@ *xhat0)
{
    memset(filter, 0, sizeof *filter);
    memcpy(filter->x, xhat0 ? xhat0 : prior_mean, sizeof filter->x);
    @unmarked@filter->step = usual_step[0]; /* that of the model's benchmark; others are found when needed */
    memcpy(filter->Phi, usual_Phi, sizeof filter->Phi);
    memcpy(filter->Gamma0, usual_Gamma0, sizeof filter->Gamma0);
    memcpy(filter->Gamma1, usual_Gamma1, sizeof filter->Gamma1);
}

/* c = a b for a and b (SIZE, SIZE) */
static void multiply(const real *a, const real *b, real *c)
{
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j < SIZE; j++) {
            real sum = 0;
            for (int k = 0; k < SIZE; k++) sum += a[i * SIZE + k] * b[k * SIZE + j];
            c[i * SIZE + j] = sum;
        }
}

/* Find Phi, Gamma0 and Gamma1 of z(t + h) = Phi z(t) + Gamma0 y(t) + Gamma1 y(t + h), for outputs that
   are linear in between: the exponential of a matrix that also integrates a constant and a ramp (Van
   Loan 1978), by its series for a step that is halved until that converges fast. */
static void find_step(@name@ *filter, real h)
{
    real M[SIZE * SIZE], E[SIZE * SIZE], term[SIZE * SIZE], next[SIZE * SIZE], norm = 0;
    int halvings = 0;
    memset(M, 0, sizeof M);
    for (int i = 0; i < NZ; i++) {
        real sum = 0;
        for (int j = 0; j < NZ; j++) M[i * SIZE + j] = h * A_z[i * NZ + j];
        for (int j = 0; j < NY; j++) M[i * SIZE + NZ + j] = h * B_z[i * NY + j];
        for (int j = 0; j < SIZE; j++) sum += fabs(M[i * SIZE + j]);
        norm = maximum(norm, sum);
    }
    for (int j = 0; j < NY; j++) M[(NZ + j) * SIZE + NZ + NY + j] = 1;
    if (DISCRETE) { /* Euler's step */
        for (int i = 0; i < NZ; i++) {
            for (int j = 0; j < NZ; j++) filter->Phi[i * NZ + j] = (i == j) + M[i * SIZE + j];
            for (int j = 0; j < NY; j++) {
                filter->Gamma0[i * NY + j] = M[i * SIZE + NZ + j];
                filter->Gamma1[i * NY + j] = 0;
            }
        }
        filter->step = h;
        return;
    }
    for (norm = maximum(norm, 1); norm > (real)0.5; norm /= 2) halvings++;
    for (int i = 0; i < SIZE * SIZE; i++) {
        M[i] = (real)ldexp(M[i], -halvings);
        E[i] = term[i] = i % (SIZE + 1) == 0;
    }
    for (int n = 1; n <= 18; n++) {
        multiply(term, M, next);
        for (int i = 0; i < SIZE * SIZE; i++) {
            term[i] = next[i] / n;
            E[i] += term[i];
        }
    }
    for (int n = 0; n < halvings; n++) {
        multiply(E, E, next);
        memcpy(E, next, sizeof E);
    }
    for (int i = 0; i < NZ; i++) {
        for (int j = 0; j < NZ; j++) filter->Phi[i * NZ + j] = E[i * SIZE + j];
        for (int j = 0; j < NY; j++) {
            const real ramp = E[i * SIZE + NZ + NY + j];
            filter->Gamma0[i * NY + j] = E[i * SIZE + NZ + j] - ramp;
            filter->Gamma1[i * NY + j] = ramp;
        }
    }
    filter->step = h;
}

static real activation(real a) { return @activation@; }

/* Evaluate a network: layers of W a + b with the activation after all but the last. ``a`` has its
   inputs, and afterwards its outputs. */
static void perceptron(const real *weights, const int *sizes, int layers, real *a)
{
    real b[WIDEST];
    for (int n = 0; n < layers; n++) {
        const real *bias = weights + sizes[n] * sizes[n + 1];
        for (int i = 0; i < sizes[n + 1]; i++) {
            real sum = 0;
            for (int j = 0; j < sizes[n]; j++) sum += weights[i * sizes[n] + j] * a[j];
            sum += bias[i];
            b[i] = n < layers - 1 ? activation(sum) : sum;
        }
        memcpy(a, b, sizeof b);
        weights = bias + sizes[n + 1];
    }
}

/* The further inputs of the networks: exp(-r t), with t since the first sample, and scaled u */
static void clock_at(real t, const real *u, real *a)
{
    int n = 0;
    for (int i = 0; i < RATES; i++) a[n++] = (real)exp(-rates[i] * t);
    for (int i = 0; i < AMPLITUDES; i++) a[n++] = u[i] / amplitudes[i];
    (void)t, (void)u, (void)a;
}

/* Integrate z, and map it to x. Return 0 if that fails. */
static int advance(@name@ *filter, struct sample *now, seconds t)
{
    real a[WIDEST], z[NZ], h[NY], x[NX];
    int missing = 0;
    for (int j = 0; j < NY; j++) missing |= now->y[j] != now->y[j];
    if (missing) { /* the model's prediction stands for an output */
        memcpy(x, filter->x, sizeof x);
        if (filter->samples) {
            const struct interval over = interval_to(filter, now, t);
            move(&over, x);
        }
        plant_h(now->t, x, now->u, plan.p, h);
        for (int j = 0; j < NY; j++)
            if (now->y[j] != now->y[j]) now->y[j] = h[j];
    }
    if (filter->samples == 0) {
        filter->first = t;
        if (FROM_PRIOR) {
            memset(a, 0, sizeof a);
            memcpy(a, filter->x, sizeof filter->x);
            for (int i = 0; TIMED && i < RATES; i++) a[NX + i] = 1;
            perceptron(encoder, encoder_sizes, ENCODER_LAYERS, a);
            memcpy(filter->z, a, sizeof filter->z);
        } else {
            for (int i = 0; i < NZ; i++) {
                filter->z[i] = 0;
                for (int j = 0; j < NY; j++) filter->z[i] += rest[i * NY + j] * now->y[j];
            }
        }
    } else {
        const real step = (real)(t - filter->t);
        if (!(fabs(step - filter->step) <= (real)1e-10 * step)) find_step(filter, step);
        for (int i = 0; i < NZ; i++) {
            z[i] = 0;
            for (int j = 0; j < NZ; j++) z[i] += filter->Phi[i * NZ + j] * filter->z[j];
            for (int j = 0; j < NY; j++)
                z[i] += filter->Gamma0[i * NY + j] * filter->y[j] + filter->Gamma1[i * NY + j] * now->y[j];
        }
        memcpy(filter->z, z, sizeof z);
    }
    memset(a, 0, sizeof a);
    memcpy(a, filter->z, sizeof filter->z);
    clock_at((real)(t - filter->first), now->u, a + NZ);
    perceptron(decoder, decoder_sizes, DECODER_LAYERS, a);
    @mark@for (int i = 0; i < NX; i++) {
        filter->x[i] = a[i];
        if (plan.low) filter->x[i] = absorbed(a[i], plan.low[i], plan.high[i]);
    }
    memcpy(filter->y, now->y, sizeof filter->y);
    return 1;
}

