/* The move of servo_move.py on a target: controller and plant, exported from quell.
 *
 * It prints u, y, the reference of the move and its feedforward in each sample, with all digits.
 */
#include <stdio.h>
#include <stdlib.h>
#include "plant.h"
#include "servo.h"

int main(void)
{
    static servo_state servo;
    static plant_state plant;

    servo_init(&servo);
    plant_init(&plant);
    for (int k = 0; k < SAMPLES; k++) {
        const double w[PLANT_DISTURBANCES] = {k >= LOAD_AT ? LOAD : 0.0};
        const double y = plant_measure(&plant);
        const double u = servo_step(&servo, k >= MOVE_AT ? TARGET : 0, (REAL)y);
        const servo_estimate estimate = servo_get_estimate(&servo);

        plant_advance(&plant, k * PLANT_SAMPLE_TIME, u, w);
        printf("%.17g %.17g %.17g %.17g\n", u, y, (double)estimate.r_shaped,
            (double)estimate.u_feedforward);
    }
    exit(0);
}
