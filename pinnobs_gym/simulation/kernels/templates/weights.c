/* The weights of particles. */

#define HALVINGS 60 /* number of bisection steps in the search of a tempering power */

/* Arrays of a call, and what is computed of the particles of a row */
struct room {
    double *drawn;            /* normal numbers, with the members as the last axis */
    double *likelihood;       /* logarithms (members,) */
    double *w;                /* weights (members,), but for the factor 1 / sum */
    double *outputs;          /* (NY, members) */
    double *old;              /* (NX, members) */
    double *ones;             /* (members,) */
    double largest, sum;      /* of the logarithms of w with the likelihood, and of w */
};

/* e^x for x <= 0, to rounding, which compilers make vector instructions of; 0 below e^-708. With
   x = k log 2 + r for a whole number k, it is 2^k times the series of e^r, |r| <= log 2 / 2. */
static inline double exponential(double x)
{
    const double shift = 6755399441055744.0; /* 1.5 * 2^52: the last bits of ``at`` are those of k */
    const double bounded = x < -708 ? -708 : x;
    const double at = bounded * 1.4426950408889634 + shift, k = at - shift;
    /* log 2 in two parts, of which the product of k with the first is exact */
    const double r = bounded - k * 6.93145751953125e-1 - k * 1.42860682030941723212e-6;
    double sum = 1.0 / 6227020800, scale;
    uint64_t bits;
    sum = sum * r + 1.0 / 479001600; sum = sum * r + 1.0 / 39916800;
    sum = sum * r + 1.0 / 3628800; sum = sum * r + 1.0 / 362880;
    sum = sum * r + 1.0 / 40320; sum = sum * r + 1.0 / 5040;
    sum = sum * r + 1.0 / 720; sum = sum * r + 1.0 / 120;
    sum = sum * r + 1.0 / 24; sum = sum * r + 1.0 / 6;
    sum = sum * r + 1.0 / 2;
    sum = (sum * r + 1) * r + 1;
    memcpy(&bits, &at, sizeof bits);
    bits = (bits + 1023) << 52;
    memcpy(&scale, &bits, sizeof bits);
    return x < -708 ? 0 : sum * scale;
}

/* Set the weights w to those of the particles times a power of the likelihood. Return the effective
   number of particles. */
static double weigh(int64_t members, const double *log_weights, double power, struct room *room)
{
    const double *restrict likelihood = room->likelihood;
    double *restrict w = room->w, most[W], largest = -INFINITY;
    int64_t first = 0;
    EACH_LANE most[l] = -INFINITY;
    for (int64_t k = 0; k < members; k++) w[k] = log_weights[k] + power * likelihood[k];
    for (; first + W <= members; first += W) EACH_LANE most[l] = maximum(w[first + l], most[l]);
    EACH_LANE largest = maximum(most[l], largest);
    for (; first < members; first++) largest = maximum(w[first], largest);
    for (int64_t k = 0; k < members; k++) w[k] = exponential(w[k] - largest);
    room->largest = largest;
    room->sum = weighted_sum(members, room->ones, w);
    return room->sum * room->sum / weighted_sum(members, w, w);
}

/* Take the weights that ``weigh`` has set, so that they sum to one. */
static void take_weights(int64_t members, double power, struct room *room, double *log_weights)
{
    const double log_sum = log(room->sum);
    for (int64_t k = 0; k < members; k++) {
        const double sum = log_weights[k] + power * room->likelihood[k];
        log_weights[k] = sum - room->largest - log_sum;
        room->w[k] /= room->sum;
    }
}

/* The power of the likelihood, at most ``remaining``, that leaves effectively half of the particles,
   by bisection */
static double tempering_power(int64_t members, const double *log_weights, double remaining,
                              struct room *room)
{
    double low = 0, high = remaining;
    for (int i = 0; i < HALVINGS; i++) {
        const double middle = (low + high) / 2;
        if (weigh(members, log_weights, middle, room) > members / 2.0) low = middle;
        else high = middle;
    }
    return high;
}
