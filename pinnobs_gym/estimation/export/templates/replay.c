/* Replays a record: lines "t,y1,...,u1,..." of a CSV file on the standard input, after one line of
   these names or the plant's own, in this order; an empty cell is a missing output. Prints t, the estimates and, where there are, their
   standard deviations. Build: cc -std=c99 -O2 @name@.c @name@_replay.c -lm -o @name@_replay */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "@name@.h"

#define COLUMNS (1 + @NAME@_OUTPUTS + @NAME@_INPUTS)

/* The names that each column may have. */
static const char *const names[COLUMNS][2] = {
    @columns@
};

/* Whether a cell of the given length, without blanks and quotes around it, is one of two names. */
static int is_named(const char *cell, size_t length, const char *const either[2])
{
    while (length && strchr(" \t\"", *cell)) cell++, length--;
    while (length && strchr(" \t\"", cell[length - 1])) length--;
    for (int i = 0; i < 2; i++)
        if (strlen(either[i]) == length && !memcmp(cell, either[i], length)) return 1;
    return 0;
}

/* Returns the number of the first column that has another name than it must, or 0. */
static int misnamed(const char *line)
{
    const char *at = line + (strncmp(line, "\xef\xbb\xbf", 3) ? 0 : 3); /* a byte order mark */
    for (int i = 0; i < COLUMNS; i++) {
        const size_t length = strcspn(at, ",\r\n");
        if (!is_named(at, length, names[i])) return i + 1;
        at += length;
        if ((i < COLUMNS - 1) != (*at == ',')) return i + 2;
        at += *at == ',';
    }
    return 0;
}

int main(void)
{
    static char line[65536];
    static @name@ filter;
    long number = 1;
    @name@_init(&filter, NULL@no_P0@);
    if (!fgets(line, sizeof line, stdin)) {
        fprintf(stderr, "the file is empty; expected a line of names\n");
        return 1;
    }
    const int wrong = misnamed(line);
    if (wrong) {
        if (wrong > COLUMNS)
            fprintf(stderr, "line 1: more than %d columns; expected only t, outputs, inputs\n",
                    COLUMNS);
        else
            fprintf(stderr, "line 1: column %d is not named %s; expected t, outputs, inputs in "
                    "their order\n", wrong, names[wrong - 1][0]);
        return 1;
    }
    while (fgets(line, sizeof line, stdin)) {
        double cells[COLUMNS];
        @real@ y[@NAME@_OUTPUTS], u[@NAME@_INPUTS + 1];
        char *at = line;
        number++;
        if (!line[strspn(line, " \t\r\n")]) continue; /* a blank line */
        for (int i = 0; i < COLUMNS; i++) {
            char *end;
            cells[i] = strtod(at, &end);
            if (end == at) cells[i] = NAN;
            at = end + strspn(end, " \t");
            const int last = i == COLUMNS - 1;
            if (last ? *at && !strchr("\r\n", *at) : *at != ',') {
                fprintf(stderr, "line %ld: cell %d is no number, or not all %d cells are there\n",
                        number, i + 1, COLUMNS);
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
