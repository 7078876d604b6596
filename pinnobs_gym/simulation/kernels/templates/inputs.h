/* Inputs that the plant defines, at a time, for W lanes. */
static inline void AT_WIDTH(known_input)(const struct plan *plan, const lanes *p, seconds t,
                                         lanes *restrict u)
{
    if (plan->p_rows) {
        EACH_LANE plant_input(t, &p[0][l], W, &u[0][l], W);
    } else { /* the same in all lanes */
        plant_input(t, &p[0][0], W, &u[0][0], W);
        for (int i = 0; i < NU; i++)
            for (int l = 1; l < W; l++) u[i][l] = u[i][0];
    }
}
