@intro@
#include <@math@.h>
#include <string.h>

#include "@name@.h"

typedef @real@ real;
