/* Golden vectors of the controller @name@, in @precision@ precision.
 *
 * The program repeats a run that quell has computed: noise, missing and absurd samples,
 * saturation, other limits, manual operation and back, restarts. It needs no more than a C
 * compiler, and runs on a target whose printf works:
 *
 *     cc -std=c99 -O2 -ffp-contract=off -Isrc test_@name@.c src/@name@.c -lm -o test_@name@
 *     ./test_@name@
 *
 * It ends with 0 if all u are within TOLERANCE of quell's and the status flags are the same, and
 * with 1 if not. Differences are in ulps: the spacing of numbers at |u|, or at the RMS of this u
 * where that is larger. @tolerance_reason@
 */
#include "@name@.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#ifndef TOLERANCE
#define TOLERANCE @tolerance@ /* [ulp]; the first argument of the program takes its place */
#endif
#define EPSILON @epsilon@
#define REFERENCES @references@
#define MEASUREMENTS @measurements@
#define ACTUATORS @actuators@

typedef @real@ real;

enum action { @actions@ };

typedef struct {
    int action;
    real r[REFERENCES];
    real y[MEASUREMENTS];
    real given[ACTUATORS]; /* u that was applied */
    real u[ACTUATORS]; /* u of the controller */
    int status;
} sample;

static const sample samples[] = {
@rows@
};

static const double scale[ACTUATORS] = {@scale@}; /* RMS of each u */

/* What the controller knows after the last sample. */
typedef struct {
    const char *name;
    real value;
    double size; /* largest |value| of the same kind */
} knowledge;

static const knowledge expected[] = {
@expected@
};

static double in_ulps(real found, real right, double size)
{
    const double ulp = EPSILON * (fabs((double)right) > size ? fabs((double)right) : size);
    return found == right ? 0.0 : fabs((double)found - (double)right) / ulp;
}

@loop@
static void play(@name@_state *state@limited_parameter@, const sample *now, real u[ACTUATORS])
{
@halves@    switch (now->action) {
@cases@
    default:
        break;
    }
    @step@;
}

/* Save, forget everything, load: nothing may change; a damaged image must be refused. */
static int power_cycle(@name@_state *state)
{
    static unsigned char image[@NAME@_MEMORY_SIZE];
    int wrong = 0;

    @name@_save(state, image);
    @name@_init(state);
    image[sizeof image / 2] ^= 1;
    wrong += @name@_load(state, image, sizeof image, true);
    image[sizeof image / 2] ^= 1;
    wrong += !@name@_load(state, image, sizeof image, true);
    if (wrong)
        printf("the memory image is not loaded as it was saved\n");
    return wrong;
}

int main(int argc, char **argv)
{
    const double tolerance = argc > 1 ? atof(argv[1]) : TOLERANCE;
    const int count = (int)(sizeof samples / sizeof samples[0]);
    static @name@_state state;
@limited_variable@    double largest = 0.0;
    int wrong = 0;

    @name@_init(&state);
    for (int k = 0; k < count; k++) {
        const sample *now = &samples[k];
        real u[ACTUATORS] = {@zero@};

        if (k == 30 || k == count - 1)
            wrong += power_cycle(&state);
        play(&state@limited_argument@, now, u);
        const int status = @name@_status(&state);

        for (int i = 0; i < ACTUATORS; i++) {
            const double difference = in_ulps(u[i], now->u[i], scale[i]);

            if (difference > largest || !(difference >= 0.0))
                largest = difference;
            if (difference <= tolerance && status == now->status)
                continue;
            if (wrong++ == 0)
                printf("sample %d: u[%d] = %.@digits@g, status %d; must be %.@digits@g, status %d\n", k,
                    i, (double)u[i], status, (double)now->u[i], now->status);
        }
    }
    const @name@_estimate estimate = @name@_get_estimate(&state);
    const real found[] = {
        @found@
    };
    for (int i = 0; i < (int)(sizeof found / sizeof found[0]); i++) {
        const knowledge *right = &expected[i];
        const double difference = in_ulps(found[i], right->value, right->size);

        if (difference > largest || !(difference >= 0.0))
            largest = difference;
        if (difference <= tolerance)
            continue;
        if (wrong++ == 0)
            printf("%s is %.@digits@g, must be %.@digits@g\n", right->name, (double)found[i],
                (double)right->value);
    }
    printf("@name@: %d samples, largest difference %.3g ulp, tolerance %.3g ulp: %s\n",
        @samples@, largest, tolerance, wrong == 0 ? "passed" : "FAILED");
    return wrong == 0 ? 0 : 1;
}
