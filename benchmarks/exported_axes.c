/* Exported axes "robot" in a loop with a plant that couples them, for exported_axes.py.
 *
 * The program reads rows (action, references, noise, shares) from its standard input: the actions
 * are those of quell.export.library.vectors. It writes what the controller was given and what it
 * returned. The plant is x_i'' = (1.2 B u)_i - 0.5 x_i' - 2 x_i + 0.5 x_(i+1) + 0.3 sin(3 x_i)
 * + 0.5 sin(0.7 t + i), in double precision, with the B that is given at the compiler's command.
 */
#include "robot.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

typedef robot_real real;

enum { N = ROBOT_AXES, M = ROBOT_ACTUATORS };
enum { STEP, APPLIED, TRACK, HAND_OVER, LIMIT, FREE, RESET, START, LEARN, HELD, RELEASED };

typedef struct {
    double action, reference[N], noise[N], share;
} row;

typedef struct {
    real r[N], y[N], given[M], u[M], status;
} result;

static robot_parameters limited;
static const double B[N][M] = GAIN;

static double clipped(double u, double most)
{
    return u > most ? most : u < -most ? -most : u;
}

static void play(robot_state *state, int action, const result *now, real u[M])
{
#if DERIVATIVES > 0
    real halves[N];

    for (int i = 0; i < N; i++)
        halves[i] = (real)0.5 * now->r[i];
#endif
    if (action == APPLIED)
        robot_applied(state, now->given);
    if (action == LIMIT) {
        limited = robot_default_parameters;
        for (int k = 0; k < M; k++)
            limited.limits.high[k] = (real)0.5;
        robot_retune(state, &limited);
    }
    if (action == FREE)
        robot_retune(state, &robot_default_parameters);
    if (action == RESET)
        robot_reset(state);
    if (action == HAND_OVER)
        (void)robot_hand_over(state);
    if (action == START)
        robot_start(state, now->y, now->given, now->r);
    if (action == HELD || action == RELEASED)
        robot_set_held(state, 0, action == HELD);
    if (action == TRACK)
        robot_track(state, now->r, now->y, now->given MORE(halves));
    else
        robot_step(state, now->r, now->y MORE(halves), u);
}

int main(void)
{
    static robot_state state, other; /* the second one runs between the samples of the first */
    double x[N] = {0.0}, rate[N] = {0.0}, u[M] = {0.0};
    row now;

    memset(&limited, 0, sizeof limited);
    memset(&state, 0xff, sizeof state); /* robot_init must set everything */
    robot_init(&state);
    robot_init(&other);
    for (long k = 0; fread(&now, sizeof now, 1, stdin) == 1; k++) {
        const int action = (int)now.action;
        const double t = (double)k * ROBOT_SAMPLE_TIME;
        result found, again;

        memset(&found, 0, sizeof found);
        for (int i = 0; i < N; i++) {
            found.r[i] = (real)now.reference[i];
            found.y[i] = (real)(x[i] + now.noise[i]);
        }
        for (int j = 0; j < M; j++)
            found.given[j] = (real)(now.share * u[j]);
        play(&state, action, &found, found.u);
        found.status = (real)robot_status(&state);
        memcpy(&again, &found, sizeof again);
        play(&other, STEP, &again, again.u);
        fwrite(&found, sizeof found, 1, stdout);
        for (int j = 0; j < M; j++) /* the actuators of the plant have limits of their own */
            u[j] = clipped(action == TRACK ? (double)found.given[j] : (double)found.u[j], 50.0);
        for (int i = 0; i < N; i++) {
            double acceleration = -0.5 * rate[i] - 2.0 * x[i] + 0.5 * x[(i + 1) % N]
                + 0.3 * sin(3.0 * x[i]) + 0.5 * sin(0.7 * t + i);

            for (int j = 0; j < M; j++)
                acceleration += 1.2 * B[i][j] * u[j];
            x[i] = clipped(x[i] + ROBOT_SAMPLE_TIME * rate[i], 100.0);
            rate[i] = clipped(rate[i] + ROBOT_SAMPLE_TIME * acceleration, 100.0);
        }
    }
    return 0;
}
