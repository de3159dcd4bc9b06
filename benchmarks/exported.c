/* An exported controller "servo" in a loop with a plant, for exported.py.
 *
 * The program reads rows (action, reference, noise, share) from its standard input: the actions are
 * those of quell.export.library.vectors. It writes what the controller was given and what it
 * returned. HAS_TRACK, HAS_START and LIMITS say what the controller has, and HALVES(x)
 * is the list of its last arguments, one x for each derivative of the reference.
 *
 * The plant is x'' = 1.5 u - 0.5 x' - 2 x + 0.3 sin(3 x) + 0.5 sin(0.7 t), in double precision.
 */
#include "servo.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

typedef servo_real real;

enum { STEP, APPLIED, TRACK, HAND_OVER, LIMIT, FREE, RESET, START };

typedef struct {
    double action, reference, noise, share;
} row;

typedef struct {
    real r, y, given, u, status; /* gcc 12 at -O2 leaves out (double)(float)x in such a struct */
} result;

static servo_parameters limited;

static real play(servo_state *state, int action, real r, real y, real given, real limit)
{
    (void)limit;
    (void)given;
    if (action == APPLIED)
        servo_applied(state, given);
#ifdef LIMITS
    if (action == LIMIT) {
        limited = servo_default_parameters;
        limited.LIMITS.high = limit;
        servo_retune(state, &limited);
    }
    if (action == FREE)
        servo_retune(state, &servo_default_parameters);
#endif
    if (action == RESET)
        servo_reset(state);
#ifdef HAS_TRACK
    if (action == HAND_OVER)
        servo_hand_over(state);
#endif
#ifdef HAS_START
    if (action == START)
        servo_start(state, y, given, r);
#endif
#ifdef HAS_TRACK
    if (action == TRACK)
        return servo_track(state, r, y, given HALVES((real)0.5 * r));
#endif
    return servo_step(state, r, y HALVES((real)0.5 * r));
}

static double clipped(double u, double most)
{
    return u > most ? most : u < -most ? -most : u;
}

int main(void)
{
    static servo_state state, other; /* the second one runs between the samples of the first */
    double x[2] = {0.0, 0.0}, u = 0.0;
    real limit = (real)0.5;
    row now;

    memset(&limited, 0, sizeof limited);
    memset(&state, 0xff, sizeof state); /* servo_init must set everything */
    servo_init(&state);
    servo_init(&other);
    for (long k = 0; fread(&now, sizeof now, 1, stdin) == 1; k++) {
        const real r = (real)now.reference, y = (real)(x[0] + now.noise);
        const real given = (real)(now.share * u);
        const int action = (int)now.action;
        const double t = (double)k * SERVO_SAMPLE_TIME;

        u = (double)play(&state, action, r, y, given, limit);
        servo_step(&other, y, r HALVES((real)0.0));
        const result found = {r, y, given, (real)u, (real)servo_status(&state)};
        fwrite(&found, sizeof found, 1, stdout);
        /* The actuator of the plant has limits of its own. */
        const double applied = clipped(action == TRACK ? (double)given : u, 50.0);
        const double acceleration = 1.5 * applied - 0.5 * x[1] - 2.0 * x[0] + 0.3 * sin(3.0 * x[0])
            + 0.5 * sin(0.7 * t);
        x[0] = clipped(x[0] + SERVO_SAMPLE_TIME * x[1], 100.0);
        x[1] = clipped(x[1] + SERVO_SAMPLE_TIME * acceleration, 100.0);
    }
    return 0;
}
