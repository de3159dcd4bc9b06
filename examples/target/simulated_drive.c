/* A simulated drive for timer_interrupt.c: an exported plant under a load, and a day in its life.
 *
 * The emulator runs it. It prints y and u of each tick and exits.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include "plant.h"
#include "servo.h"

#define LOAD (-3.0)
enum { STEP = 200, MANUAL = 1200, AUTOMATIC = 1700, RETUNE = 2500 }; /* ticks */
enum { BLIND = 3000, LOST = 3300, END = 3400 };

extern volatile float reference, manual_u;
extern volatile bool manual, is_off;
extern const servo_parameters *volatile retuned;

static plant_state plant;
static double y_log[END], u_log[END];
static int tick, fed, is_safe;

double drive_holding(void) { return -LOAD; }
void watchdog_start(double seconds) { (void)seconds; }
void watchdog_feed(void) { fed++; }
void drive_off(void) { is_safe = 1; }

/* NaN for 5 samples, which the controller bridges, and for good in the end. */
double drive_measure(void)
{
    int no_sensor = (tick >= BLIND && tick < BLIND + 5) || tick >= LOST;
    if (plant.parameters == NULL)
        plant_init(&plant);
    return no_sensor ? NAN : plant_measure(&plant);
}

double drive_apply(double u)
{
    static servo_parameters faster;
    if (tick == END) {
        for (int k = 0; k < END; k++)
            printf("%.9g %.9g\n", y_log[k], u_log[k]);
        exit(fed == END && is_safe && is_off ? 0 : 1);
    }
    u = is_safe ? 0.0 : fmin(fmax(u, -10.0), 10.0);
    y_log[tick] = plant_measure(&plant);
    u_log[tick] = u;
    const double load[PLANT_DISTURBANCES] = {LOAD};
    plant_advance(&plant, tick * PLANT_SAMPLE_TIME, u, load);
    tick++;
    if (tick == STEP)
        reference = 1.0f;
    if (tick == RETUNE) {
        faster = servo_default_parameters;
        faster.law[0] = 400; /* omega_c = 20 rad/s instead of 10 */
        faster.law[1] = 40;
        faster.limits.high = 5;
        retuned = &faster;
    }
    manual_u = 3.2f;
    manual = tick >= MANUAL && tick < AUTOMATIC;
    return u;
}
