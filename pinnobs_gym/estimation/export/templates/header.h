@intro@
#ifndef @NAME@_H
#define @NAME@_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define @NAME@_STATES @NX@
#define @NAME@_OUTPUTS @NY@
#define @NAME@_INPUTS @NU@
#define @NAME@_CHECKSUM @checksum@u /* of the model, its settings and the code */

/* What became of a sample. All but @NAME@_OK leave the filter as it was. */
typedef enum {
    @NAME@_OK,
    @NAME@_TIME,     /* t is not finite, or does not increase@or_whole@ */
    @NAME@_GAP,      /* too long since the sample before */
    @NAME@_OUTPUT,   /* an output is infinite */
    @NAME@_INPUT,    /* an input is not finite */
    @NAME@_NUMERICS  /* the result is not finite, or outside of what this code covers */
} @name@_status;

/* The filter. Matrices are stored row by row. */
typedef struct {
    double t;             /* time of the last sample in @time_unit@ */
    uint32_t samples;     /* number of samples so far; 0 before the first */
    @real@ x[@NX@];       /* estimates: @states@ */
    @real@ u[@LU@];       /* inputs at the last sample */
    @fields@
} @name@;

/* Start. @start@ */
void @name@_init(@name@ *filter, const @real@ *xhat0@P0@);

/* Take the sample at time t: outputs y (@NY@), of which NAN is a missing one, and inputs u@inputs@. */
@name@_status @name@_update(@name@ *filter, double t, const @real@ *y, const @real@ *u);

#ifdef __cplusplus
}
#endif

#endif
