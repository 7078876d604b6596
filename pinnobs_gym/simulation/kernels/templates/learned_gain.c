/* The extended Kalman filter whose gain a network corrects, as pinnobs_gym/estimators/pinn_gain.py
   says. ``carried`` is the moving average of each output's squared normalised innovation. */
#define INPUTS (2 * NX + 3 * NY + NX * (NX - 1) / 2)
#define TINY 1e-12

/* The prediction: x moves by the model, and P by its linearisation. */
static inline void AT_WIDTH(predict)(const struct interval *over, lanes *restrict x,
                                     lanes *restrict P, int64_t *restrict bad)
{
    (void)bad;
    AT_WIDTH(move_moments)(over, x, P, NULL);
}

/* b = W a + b0 for the weights (n, m) of a layer, after which its biases b0 follow. Return the place
   after these. */
static const double *AT_WIDTH(layer)(int64_t n, int64_t m, const double *restrict weights,
                                     const lanes *restrict a, lanes *restrict b)
{
    const double *const biases = weights + n * m;
    for (int64_t i = 0; i < n; i++) {
        EACH_LANE b[i][l] = 0;
        for (int64_t q = 0; q < m; q++) EACH_LANE b[i][l] += weights[i * m + q] * a[q][l];
        EACH_LANE b[i][l] += biases[i];
    }
    return biases + n;
}

/* Correct the Kalman gain K (NX, NY), given the share of H P H^T in S of each output. */
static void AT_WIDTH(correct_gain)(const struct plan *plan, const struct sample *restrict s,
                                   const lanes *restrict x, const lanes *restrict P,
                                   const lanes *restrict average, const lanes *restrict share,
                                   lanes *restrict K)
{
    lanes inputs[INPUTS], hidden[2][WIDEST], outputs[2 * NX * NY], sd[NX];
    const double *weights = plan->network, *const scale = plan->scale, largest = log(8.0);
    lanes *at = inputs;
    for (int i = 0; i < NX; i++, at++) {
        const double period = plan->state_period ? plan->state_period[i] : 0;
        EACH_LANE at[0][l] = (period ? nearest(x[i][l], 0, period) : x[i][l]) / scale[i];
        EACH_LANE sd[i][l] = sqrt(P[i * NX + i][l]);
    }
    for (int j = 0; j < NY; j++, at++)
        EACH_LANE at[0][l] = asinh(s->e[j][l] / sqrt(s->S[j * NY + j][l]));
    for (int j = 0; j < NY; j++, at++) EACH_LANE at[0][l] = asinh(average[j][l]);
    for (int i = 0; i < NX; i++, at++)
        EACH_LANE at[0][l] = log(P[i * NX + i][l] / (scale[i] * scale[i]) + TINY) / 6;
    for (int j = 0; j < NY; j++, at++) EACH_LANE at[0][l] = sqrt(share[j][l]);
    for (int i = 1; i < NX; i++)
        for (int q = 0; q < i; q++, at++)
            EACH_LANE at[0][l] =
                P[i * NX + q][l] / (sd[i][l] * sd[q][l] + TINY * scale[i] * scale[q]);
    weights = AT_WIDTH(layer)(plan->width, INPUTS, weights, inputs, hidden[0]);
    for (int64_t i = 0; i < plan->width; i++) EACH_LANE hidden[0][i][l] = tanh(hidden[0][i][l]);
    weights = AT_WIDTH(layer)(plan->width, plan->width, weights, hidden[0], hidden[1]);
    for (int64_t i = 0; i < plan->width; i++) EACH_LANE hidden[1][i][l] = tanh(hidden[1][i][l]);
    AT_WIDTH(layer)(2 * NX * NY, plan->width, weights, hidden[1], outputs);
    /* A bounded factor of the gain, and a bounded gain added to it */
    for (int j = 0; j < NY; j++) {
        lanes fade, size;
        EACH_LANE fade[l] = pow(share[j][l], 0.75), size[l] = sqrt(s->S[j * NY + j][l]);
        for (int i = 0; i < NX; i++)
            EACH_LANE {
                const int place = i * NY + j;
                const double factor = tanh(outputs[place][l] * fade[l]);
                const double shift = tanh(outputs[NX * NY + place][l] * fade[l]);
                K[place][l] = K[place][l] * exp(largest * factor) + shift * (sd[i][l] / size[l]);
            }
    }
}

/* Correct x and P by a gain: x = x + K e, P = (I - K H) P (I - K H)^T + K R K^T. */
static inline void AT_WIDTH(update_with)(const struct sample *restrict s, const lanes *restrict H,
                                         const lanes *restrict K, lanes *restrict x,
                                         lanes *restrict P)
{
    lanes M[NX * NX], KR[NX * NY], noise[NX * NX], step[NX];
    AT_WIDTH(product)(NX, NY, NX, K, H, M);
    for (int i = 0; i < NX * NX; i++) EACH_LANE M[i][l] = -M[i][l];
    for (int i = 0; i < NX; i++) EACH_LANE M[i * NX + i][l] += 1;
    AT_WIDTH(sandwich)(NX, M, P);
    AT_WIDTH(product)(NX, NY, NY, K, s->R, KR);
    AT_WIDTH(symmetric)(NX, NY, KR, K, noise);
    for (int i = 0; i < NX * NX; i++) EACH_LANE P[i][l] += noise[i][l];
    AT_WIDTH(product)(NX, NY, 1, K, s->e, step);
    for (int i = 0; i < NX; i++) EACH_LANE x[i][l] += step[i][l];
}

/* Correct x and P by the outputs of a sample. Lanes that NumPy has to correct are marked in
   ``bad``. */
SEPARATE void AT_WIDTH(correct)(const struct plan *plan, const lanes *restrict p,
                                struct sample *restrict s, lanes *restrict x, lanes *restrict P,
                                struct memory *restrict memory, int64_t *restrict bad)
{
    lanes H[NY * NX], HP[NY * NX], K[NX * NY], share[NY], *const average = memory->carried, rest;
    AT_WIDTH(observe)(plan, p, x, s, H);
    AT_WIDTH(output_moments)(H, P, s->R, HP, s->S);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NY; j++) EACH_LANE K[i * NY + j][l] = HP[j * NX + i][l];
    AT_WIDTH(divide)(NX, s->S, K, bad);
    for (int j = 0; j < NY; j++) {
        EACH_LANE share[j][l] = 1 - s->R[j * NY + j][l] / s->S[j * NY + j][l];
        EACH_LANE share[j][l] = share[j][l] < 0 ? 0 : share[j][l];
    }
    AT_WIDTH(correct_gain)(plan, s, x, P, average, share, K);
    for (int j = 0; j < NY; j++)
        EACH_LANE {
            const double nis = s->e[j][l] * s->e[j][l] / s->S[j * NY + j][l];
            const double limited = nis > 100 ? 100 : nis, now = average[j][l];
            average[j][l] = s->y[j][l] == s->y[j][l] ? now + 0.1 * (limited - now) : now;
        }
    AT_WIDTH(update_with)(s, H, K, x, P);
    EACH_LANE rest[l] = 0;
    for (int i = 0; i < NX; i++) EACH_LANE rest[l] += x[i][l];
    for (int i = 0; i < NX * NX; i++) EACH_LANE rest[l] += P[i][l];
    EACH_LANE bad[l] |= (rest[l] - rest[l] != 0) & !memory->lost[l];
    AT_WIDTH(mark_outside)(plan, x, bad);
}
