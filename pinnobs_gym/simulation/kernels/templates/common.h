/* What does not depend on the number of lanes. */
#include <math.h>
#include <stdint.h>
#include <string.h>

/* A function whose code is not repeated where it is called, for the sake of compile time */
#if defined(__GNUC__)
#define SEPARATE static __attribute__((noinline))
#else
#define SEPARATE static
#endif

typedef double seconds; /* times: numbers of double precision in code of any other */

#define MIN(a, b) ((a) < (b) ? (a) : (b))

/* NumPy's functions, NaN included, that C does not have. */
static inline double maximum(double a, double b) { return a > b || a != a ? a : b; }
static inline double minimum(double a, double b) { return a < b || a != a ? a : b; }
static inline double sign(double a) { return a > 0 ? 1.0 : a < 0 ? -1.0 : a; }
static inline double heaviside(double a, double half)
{
    return a > 0 ? 1.0 : a < 0 ? 0.0 : a == 0 ? half : a;
}

/* Return a state within its bounds; one that is not finite remains. */
static inline double absorbed(double x, double low, double high)
{
    return !isfinite(x) ? x : x < low ? low : x > high ? high : x;
}

/* Return a difference in [-period/2, period/2); one that is there already is unchanged. */
static inline double wrapped(double difference, double period)
{
    const double half = period / 2;
    if (-half <= difference && difference < half) return difference;
    double rest = fmod(difference, period);
    if (rest < 0) rest += period;
    return rest >= half ? rest - period : rest;
}

/* Return the value less whole periods, within half a period of the reference. */
static inline double nearest(double value, double reference, double period)
{
    return value - period * floor((value - reference) / period + 0.5);
}

/* What stays the same over the samples of a call. The batch is the last axis of all arrays. */
struct plan {
    const double *p;          /* the plant's numbers, (NP, 1 or batch) */
    int64_t p_rows;           /* 1, or 0 if p is the same in all rows */
    const double *L;          /* process noise, (NX, m) */
    int64_t m;
    const double *D;          /* L L^T, (NX, NX) */
    int64_t diagonal;         /* 1 if D is diagonal */
    const double *R;          /* output noise, (1 or samples, NY, NY, 1 or batch) */
    int64_t R_samples;        /* 1, or 0 if R is the same at all samples */
    int64_t R_rows;           /* 1, or 0 if R is the same in all rows */
    double longest;           /* longest Runge-Kutta step in s */
    const seconds *breaks;    /* ascending times at which f jumps */
    int64_t num_breaks;
    int64_t input;            /* 0: defined by the plant, 1: measured and held, 2: joined */
    int64_t discrete;         /* 1 if the plant is a map */
    const double *state_period;   /* (NX,), 0 for a state that does not repeat; or NULL */
    const double *output_period;  /* (NY,), or NULL */
    const double *low, *high; /* bounds of the states, (NX,), or NULL */
    /* EKF */
    const double *gate;       /* bounds of the NIS, (NY + 1,), or NULL */
    int64_t patience;
    double huber;             /* 0 for none */
    const double *growth;     /* variances (NX,) that P grows by at an innovation of size 1, or NULL */
    double caution;           /* factor with which H P H^T is added to R */
    const double *network;    /* weights and biases of a learned gain, layer by layer, or NULL */
    int64_t width;            /* number of neurons of its layers */
    const double *scale;      /* (NX,) of the states, or NULL */
    double theta;             /* rate of forgetting in 1/s */
    const double *per_scale;  /* (NX,) scale^-2 of the states, or NULL */
    double switching, layer;  /* of a sliding mode: ratio to the layer, and its width in deviations */
    int64_t carried;          /* number of entries of ``carried`` of filter.h that are in use */
    /* sigma-point filters; at most 2 NX + 1 points */
    const double *points;     /* (num_points, NX) for the standard normal distribution */
    const double *weights;    /* (num_points,) in means */
    const double *roots;      /* (num_points,) square roots of the weights in covariances */
    int64_t num_points;
    double outlier_rate;      /* probability of an outlier, 0 for none */
    double outlier_size;      /* its standard deviation in those of R */
};
