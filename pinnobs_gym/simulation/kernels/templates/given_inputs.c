/* Inputs that are given with samples, of plants that define their own. */

/* Set u (NU,) to the inputs that the plant defines in a row. */
static void defined_inputs(const struct plan *plan, int64_t batch, int64_t row, double t, double *u)
{
    double p[LP];
    for (int i = 0; i < NP; i++) p[i] = plan->p[plan->p_rows ? i * batch + row : i];
    plant_input(t, p, 1, u, 1);
}

/* 1 if the inputs u (NU, batch) of a row are not those that the plant defines */
static int other_inputs(const struct plan *plan, int64_t batch, int64_t row, double t,
                        const double *u)
{
    double known[LU];
    int wrong = 0;
    if (NU == 0 || plan->input != 0) return 0;
    defined_inputs(plan, batch, row, t, known);
    for (int i = 0; i < NU; i++) {
        const double given = u[i * batch + row], size = fmax(fabs(given), fabs(known[i]));
        wrong |= !(fabs(given - known[i]) <= 1e-6 * size);
    }
    return wrong;
}
