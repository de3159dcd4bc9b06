/* The time of a step [ns]: the exported controller "servo", and that of reference.c by hand.
 *
 * Reads the files design, r and y of the folder; both run over the same samples, in turns.
 */
#include "reference.c"
#include "servo.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static double *numbers(const char *name, size_t *count)
{
    FILE *file = fopen(name, "rb");
    if (!file || fseek(file, 0, SEEK_END)) exit(2);
    const long size = ftell(file);
    double *found = malloc((size_t)size);
    rewind(file);
    *count = (size_t)size / sizeof *found;
    if (!found || fread(found, sizeof *found, *count, file) != *count) exit(2);
    fclose(file);
    return found;
}

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Not inlined, as a function of another file. */
__attribute__((noinline)) double by_hand(const design_t *d, state_t *s, double r, double y)
{
    return step(d, s, r, y);
}

int main(void)
{
    size_t size, count;
    design_t design;
    double best[2] = {1e300, 1e300}, sum[2] = {0.0, 0.0};
    const double *values = numbers("design", &size);
    if (size * sizeof *values != sizeof design) return 3;
    memcpy(&design, values, sizeof design);
    const double *r = numbers("r", &count), *y = numbers("y", &count);
    for (int trial = 0; trial < 15; trial++) {
        static servo_state state;
        state_t other = {0};
        double began = seconds();
        servo_init(&state);
        for (size_t k = 0; k < count; k++) sum[0] += servo_step(&state, r[k], y[k]);
        double took = seconds() - began;
        if (took < best[0]) best[0] = took;
        began = seconds();
        for (int i = 0; i < NX; i++) other.cov[i][i] = design.prior * design.prior;
        for (size_t k = 0; k < count; k++) sum[1] += by_hand(&design, &other, r[k], y[k]);
        took = seconds() - began;
        if (took < best[1]) best[1] = took;
    }
    if (!(fabs(sum[0] - sum[1]) < 1e-6 * fabs(sum[1]))) return 4; /* not the same controller */
    printf("%.2f %.2f\n", 1e9 * best[0] / (double)count, 1e9 * best[1] / (double)count);
    return 0;
}
