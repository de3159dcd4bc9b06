/* A controller "servo" in a loop for very many samples: arguments are their number, and 1 for a plant
 * in motion, 0 at rest.
 *
 * The plant is x'' = 1.5 u - 0.5 x' - k x + 0.2 with noise in y; k is 2, and 3 in the last tenth.
 * At rest r = 1. Prints columns for exported.py, separated by |.
 */
#include "servo.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

static double noise(void)
{
    static uint64_t seed = 1;
    double sum = 0.0;
    for (int i = 0; i < 4; i++) { /* of four uniform numbers, nearly normal */
        seed = seed * 6364136223846793005u + 1442695040888963407u;
        sum += (double)(seed >> 40) / 16777216.0 - 0.5;
    }
    return 1e-4 * sum;
}

int main(int argc, char **argv)
{
    const long samples = argc > 1 ? (long)atof(argv[1]) : 0;
    const int moving = argc > 2 && argv[2][0] == '1';
    static servo_state state;
    double x = 0.0, v = 0.0, errors[10] = {0.0}, means[10] = {0.0};
    long bad = 0;
    int flags = 0;

    servo_init(&state);
    for (long k = 0; k < samples; k++) {
        const int tenth = (int)(10.0 * (double)k / (double)samples);
        const long period = k % 6283; /* sin of small numbers only: the loop does not drift */
        const double r = moving ? sin(1e-3 * (double)period * 6283.185307179586 / 6283.0) : 1.0;
        const double y = x + noise();
        const double u = servo_step(&state, (servo_real)r, (servo_real)y);
        const double stiffness = moving && tenth == 9 ? 3.0 : 2.0;

        flags |= servo_status(&state);
        if (!isfinite(u)) {
            bad++;
            continue;
        }
        if (k > samples / 1000) {
            errors[tenth] += (r - x) * (r - x);
            means[tenth] += u;
        }
        x += SERVO_SAMPLE_TIME * v;
        v += SERVO_SAMPLE_TIME * (1.5 * u - 0.5 * v - stiffness * x + 0.2);
    }
    const double count = (double)samples / 10.0;
    printf("%.4g, %.4g, %.4g|", sqrt(errors[0] / count), sqrt(errors[8] / count),
        sqrt(errors[9] / count));
    printf("%.5f, %.5f, %.5f|", means[0] / count, means[8] / count, means[9] / count);
#ifdef HAS_THETA
    const servo_estimate found = servo_get_estimate(&state);
    printf("authority %.3f, theta %.4f %.4f", (double)found.authority, (double)found.theta[0],
        (double)found.theta[1]);
#endif
    printf("|%d|%ld", flags, bad);
    return 0;
}
