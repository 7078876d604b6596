/* What steps are given, and what each of the functions made by step_code.py, or in loops by loops.h,
   computes:

   runge_kutta             x at the end of a step, from x at its start
   runge_kutta_linearised  the same, with the Jacobian F (NX, NX) of the step, and those of f at its
                           first and last stage. F integrates the variational equation F' = A F by
                           the same method at the same stages.
   add_step                P of move_moments over a step, if D = L L^T is diagonal; straight only
   add_map_step            P = F P F^T + D
   output_moments          H P and S = H P H^T + R
   kalman_update           x = x + K e and P = (I - K H) P (I - K H)^T + K R K^T for
                           K = P H^T S^-1; ``rest`` (W,) is zero where all of these are finite
   smooth_step             x and P of a smoother, see smoother.c; ``determinant`` (W,) is that of the
                           correlations of P_ahead */
/* A step of the classical Runge-Kutta method: its times, inputs and length. */
#define rk_step AT_WIDTH(rk_step)
struct rk_step {
    double h;
    lanes t[3];
    lanes u[3][LU];           /* at the start, the middle and the end */
};
