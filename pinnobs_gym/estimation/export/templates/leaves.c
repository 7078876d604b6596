/* Inputs that the plant defines, at a time. */
static inline void known_input(const struct plan *plan, const real *p, seconds t, real *u)
{
    (void)plan;
    plant_input(t, p, 1, u, 1);
}
