#define PI 3.14159265358979323846
/* Give P the covariance that errors have when whole periods of angles do not count: D P D, with D =
   diag(g), plus f - g^2 P_ii on the diagonal, where g is the slope of the best linear prediction of a
   wrapped normal variable by the variable, and f its variance (Mardia & Jupp 2000, 3.5.7). */
static void wrap_covariance(const struct plan *plan, real *P)
{
    for (int i = 0; i < NX; i++) {
        const real period = plan->state_period[i], variance = P[i * NX + i];
        if (period == 0 || !(variance > period / 12 * (period / 12))) continue;
        const real turn = period / (2 * (real)PI);
        real g = 0, f = (real)PI * (real)PI / 3;
        for (int n = 1; n <= 12; n++) {
            const real sign_n = n % 2 ? 1 : -1;
            const real term = sign_n * (real)exp(-0.5 * n * n * (variance / (turn * turn)));
            g += 2 * term;
            f -= 4 * term / (n * n);
        }
        f *= turn * turn;
        for (int j = 0; j < NX; j++) {
            P[i * NX + j] *= g;
            P[j * NX + i] *= g;
        }
        P[i * NX + i] = g < 1 ? f : variance;
    }
}

static void after_prediction(const struct plan *plan, real *P) { wrap_covariance(plan, P); }
