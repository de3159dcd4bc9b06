/* A machine of the moving pictures: its plant, and its loop in three structures.
 *
 * moving_loop.py writes machine.h and, with quell's export, the four pairs of files that it
 * includes. All arithmetic of plant and controller is in those; run() calls them in the order of
 * quell's simulation, so y, u and the estimates have the bits of a run of simulate(). */
#include "machine.h"

#include <string.h>

enum { PLAIN, LEARNER, GUARDED };

/* Room for the samples of one call of run(): the caller writes r and w, run() the others. */
double log_r[ROOM], log_w[ROOM][LOADS], log_y[ROOM], log_u[ROOM], log_x[ROOM + 1][STATES];
double log_f_hat[ROOM], log_f_learned[ROOM], log_authority[ROOM];

static plant_state plant;
static plain_state plain;
static learner_state learner;
static guarded_state guarded;

/* A retuned loop compares its old parameters with the new ones, so there is room for both. */
static plain_parameters plain_designs[2];
static learner_parameters learner_designs[2];
static guarded_parameters guarded_designs[2];
static int structure, design;
static double samples_run;

/* Return the parameters that the next start() or retune() takes, to be changed before it. */
void *next_design(int of)
{
    int next = 1 - design;
    return of == PLAIN ? (void *)&plain_designs[next]
        : of == LEARNER ? (void *)&learner_designs[next] : (void *)&guarded_designs[next];
}

/* Set the parameters to those of the machine's first design. */
void begin(void)
{
    for (int i = 0; i < 2; i++) {
        plain_designs[i] = plain_default_parameters;
        learner_designs[i] = learner_default_parameters;
        guarded_designs[i] = guarded_default_parameters;
    }
}

/* Parameters that are not changed again stay those of the design before. */
static void take_design(void)
{
    int before = design;
    design = 1 - design;
    plain_designs[before] = plain_designs[design];
    learner_designs[before] = learner_designs[design];
    guarded_designs[before] = guarded_designs[design];
}

/* The initial variance of a coefficient follows from the design. */
#define START(name) \
    do { \
        name##_init(&name); \
        name.parameters = &name##_designs[design]; \
    } while (0)
#define START_LEARNER(name) \
    do { \
        START(name); \
        for (int i = 0; i < ORDER; i++) { \
            const double prior = name##_designs[design].learner.prior[i]; \
            name.learner.covariance[i][i] = prior * prior; \
        } \
    } while (0)

static void start_loop(int of)
{
    structure = of;
    if (of == PLAIN) {
        START(plain);
    } else if (of == LEARNER) {
        START_LEARNER(learner);
    } else {
        START_LEARNER(guarded);
    }
}

/* Start plant and loop from rest, with the next design. */
void start(int of)
{
    plant_init(&plant);
    samples_run = 0.0;
    take_design();
    start_loop(of);
}

/* Continue with the next design. */
void retune(void)
{
    /* take_design() makes both equal: keep the old one until the loop has compared them. */
    if (structure == PLAIN) {
        plain_retune(&plain, &plain_designs[1 - design]);
    } else if (structure == LEARNER) {
        learner_retune(&learner, &learner_designs[1 - design]);
    } else {
        guarded_retune(&guarded, &guarded_designs[1 - design]);
    }
    take_design();
}

/* Continue with another structure: the observer keeps its state, a new learner knows nothing. */
void change_structure(int to)
{
    double known[ORDER + 1], u = 0.0, r = 0.0, y = 0.0;

    if (to == structure) {
        return;
    }
#define READ(name) \
    do { \
        const name##_estimate now = name##_get_estimate(&name); \
        for (int i = 0; i < ORDER; i++) { \
            known[i] = now.x_hat[i]; \
        } \
        known[ORDER] = now.f; \
        u = name.loop.u; \
        r = name.loop.r; \
        y = name.loop.y; \
    } while (0)
    if (structure == PLAIN) {
        READ(plain);
    } else if (structure == LEARNER) {
        READ(learner);
    } else {
        READ(guarded);
    }
    start_loop(to);
#define WRITE(name) \
    do { \
        for (int i = 0; i <= ORDER; i++) { \
            name.z[i] = name.estimates[i] = known[i]; \
        } \
        name.loop.u = u; \
        name.loop.r = r; \
        name.loop.y = y; \
        name.loop.started = name.loop.has_reference = true; \
    } while (0)
    if (to == PLAIN) {
        WRITE(plain);
    } else if (to == LEARNER) {
        WRITE(learner);
    } else {
        WRITE(guarded);
    }
}

/* Run a number of samples, at most ROOM. */
void run(int samples)
{
    for (int k = 0; k < samples; k++) {
        const double y = plant_measure(&plant), measured = y + 0.0; /* there is no noise */

        for (int i = 0; i < STATES; i++) {
            log_x[k][i] = plant.x[i];
        }
        log_y[k] = y;
        log_f_learned[k] = log_authority[k] = 0.0;
        if (structure == PLAIN) {
            log_u[k] = plain_step(&plain, log_r[k], measured);
            log_f_hat[k] = plain_get_estimate(&plain).f;
        } else if (structure == LEARNER) {
            log_u[k] = learner_step(&learner, log_r[k], measured);
            log_f_hat[k] = learner_get_estimate(&learner).f;
            log_f_learned[k] = learner_get_estimate(&learner).f_learned;
            log_authority[k] = 1.0;
        } else {
            guarded_estimate now;
            log_u[k] = guarded_step(&guarded, log_r[k], measured);
            now = guarded_get_estimate(&guarded);
            log_f_hat[k] = now.f;
            log_f_learned[k] = now.f_learned;
            log_authority[k] = now.authority;
        }
        plant_advance(&plant, samples_run * SAMPLE_TIME, log_u[k], log_w[k]);
        samples_run += 1.0;
    }
    for (int i = 0; i < STATES; i++) {
        log_x[samples][i] = plant.x[i];
    }
}
