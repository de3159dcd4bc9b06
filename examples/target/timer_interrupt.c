/* A controller of quell in a timer interrupt of a Cortex-M, without vendor code.
 *
 * "servo" is the name given to quell export. Write the functions below for your drive: they are all
 * that this file needs of the board, with timer_start() and timer_is_late() of mps2.h.
 */
#include "mps2.h"
#include "servo.h"

#define MOST_MISSING 20 /* samples without measurement until the drive is switched off */

double drive_measure(void);     /* return y; NaN if the sensor gives none. No filter, no step of y */
double drive_apply(double u);   /* apply u; return what the drive really applies, a finite number */
double drive_holding(void);     /* return the u that is applied before the controller takes over */
void drive_off(void);           /* make the drive safe; stays until the next reset */
void watchdog_start(double seconds);
void watchdog_feed(void);

/* The main loop writes these, the interrupt reads them. Each is one word, so that the interrupt never
 * reads half of it: float in double precision, too. */
volatile float reference;
volatile float manual_u;
volatile bool manual; /* u is manual_u */
const servo_parameters *volatile retuned; /* parameters to change to, or 0 */

/* The interrupt writes these, for telemetry. */
volatile uint32_t ticks, late_ticks;
volatile bool is_off;

static servo_state servo;
static int missing;

static double control(double y)
{
    static bool was_manual;
    if (manual) {
        was_manual = true;
        servo_track(&servo, reference, y, manual_u); /* the estimates go on under the manual u */
        return manual_u;
    }
    if (was_manual && servo_hand_over(&servo))
        was_manual = false; /* the next step goes on from the manual u */
    return servo_step(&servo, reference, y);
}

void systick_handler(void)
{
    double y = drive_measure();
    double u = control(y);
    double applied = drive_apply(u);
    if (applied != u) /* the drive has limits that the controller does not know */
        servo_applied(&servo, applied);
    missing = servo_status(&servo) & SERVO_MEASUREMENT_HELD ? missing + 1 : 0;
    if (missing >= MOST_MISSING)
        is_off = true;
    if (is_off)
        drive_off();
    if (retuned) { /* a few hundred instructions, after u is out */
        servo_retune(&servo, retuned);
        retuned = 0;
    }
    ticks++;
    late_ticks += timer_is_late();
    watchdog_feed(); /* here and nowhere else: it says that u has just been computed */
}

int main(void)
{
    double y;
    do
        y = drive_measure();
    while (y != y); /* NaN: no start without measurement */
    reference = (float)y;
    servo_init(&servo);
    /* The plant rests at y, held by u: long, and therefore before the timer starts. */
    servo_start(&servo, y, drive_holding(), reference);
    watchdog_start(5.0 * SERVO_SAMPLE_TIME);
    timer_start(SERVO_SAMPLE_TIME);
    for (;;)
        __asm volatile("wfi"); /* telemetry, commands, retuning: everything that may wait */
}
