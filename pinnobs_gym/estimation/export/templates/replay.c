/* Replays a record: lines "t,y1,...,u1,..." of a CSV file on the standard input, after one line of
   names; an empty cell is a missing output. Prints t, the estimates and, where there are, their
   standard deviations. Build: cc -std=c99 -O2 @name@.c @name@_replay.c -lm -o @name@_replay */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "@name@.h"

int main(void)
{
    static char line[65536];
    static @name@ filter;
    long number = 1;
    @name@_init(&filter, NULL@no_P0@);
    if (!fgets(line, sizeof line, stdin)) return 1;
    while (fgets(line, sizeof line, stdin)) {
        double cells[1 + @NAME@_OUTPUTS + @NAME@_INPUTS];
        @real@ y[@NAME@_OUTPUTS], u[@NAME@_INPUTS + 1];
        char *at = line;
        number++;
        if (!line[strspn(line, " \t\r\n")]) continue; /* a blank line */
        for (int i = 0; i < 1 + @NAME@_OUTPUTS + @NAME@_INPUTS; i++) {
            char *end;
            cells[i] = strtod(at, &end);
            if (end == at) cells[i] = NAN;
            at = end + strspn(end, " \t");
            const int last = i == @NAME@_OUTPUTS + @NAME@_INPUTS;
            if (last ? *at && !strchr("\r\n", *at) : *at != ',') {
                fprintf(stderr, "line %ld: cell %d is no number, or not all %d cells are there\n",
                        number, i + 1, 1 + @NAME@_OUTPUTS + @NAME@_INPUTS);
                return 1;
            }
            at++;
        }
        for (int i = 0; i < @NAME@_OUTPUTS; i++) y[i] = (@real@)cells[1 + i];
        for (int i = 0; i < @NAME@_INPUTS; i++) u[i] = (@real@)cells[1 + @NAME@_OUTPUTS + i];
        u[@NAME@_INPUTS] = 0;
        const @name@_status status = @name@_update(&filter, cells[0], y, u);
        if (status != @NAME@_OK) {
            fprintf(stderr, "line %ld: status %d\n", number, (int)status);
            return 1;
        }
        printf("%.17g", cells[0]);
        for (int i = 0; i < @NAME@_STATES; i++) printf(",%.17g", (double)filter.x[i]);
        @print_std@
        printf("\n");
    }
    return 0;
}
