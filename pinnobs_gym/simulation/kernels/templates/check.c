/* Values of the plant's functions at ``n`` points, with the points as the last axis of all arrays,
   by which a library is compared with the system's own functions before it is used. */
void evaluate(const struct plan *plan, int64_t n, const double *t, const double *x, const double *u,
              double *f, double *A, double *h, double *H, double *input)
{
    for (int64_t row = 0; row < n; row++) {
        double p1[LP][1], t1[1] = {t[row]}, x1[NX][1], u1[LU][1];
        double f1[NX][1], A1[NX * NX][1], h1[NY][1], H1[NY * NX][1], input1[LU];
        load_1(NP, plan->p, plan->p_rows ? n : 0, row, 1, p1);
        load_1(NX, x, n, row, 1, x1);
        load_1(NU, u, n, row, 1, u1);
        plant_f_linearised_1(t1, x1, u1, p1, f1, A1);
        plant_h_linearised_1(t1, x1, u1, p1, h1, H1);
        plant_input(t[row], &p1[0][0], 1, input1, 1);
        store_1(NX, f1, f, n, row, 1);
        store_1(NX * NX, A1, A, n, row, 1);
        store_1(NY, h1, h, n, row, 1);
        store_1(NY * NX, H1, H, n, row, 1);
        for (int i = 0; i < NU; i++) input[i * n + row] = input1[i];
    }
}
