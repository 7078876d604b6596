/* The arrays of a call of a moving window, with the batch as the last axis. The window has the
   samples before and, as the last one, a new sample. Of windows whose states are all unknown, P is
   the lower triangular root of the covariance, and ``start`` has the states at all samples but the
   new one, ``start_after`` those of the window after it. */
#ifndef WINDOW
#define WINDOW
struct window {
    const struct plan *plan;
    int64_t batch, samples;
    int64_t most, rounds;     /* samples of a window, and Gauss-Newton steps per sample */
    const double *t;          /* (samples,) */
    const double *y;          /* (samples, NY, batch); NaN is missing */
    const double *u;          /* (samples, NU, batch) */
    const double *mean, *P;   /* prior of the first state before: (NX, batch), (NX, NX, batch) */
    const double *start;      /* its estimate (NX, batch) */
    double *mean_after, *P_after, *start_after;
    double *x, *P_x;          /* the last state and its covariance */
    double *innovation, *S;   /* of the last sample */
    int64_t *left;            /* (batch,) 1 in rows that are left to NumPy */
};
#endif
