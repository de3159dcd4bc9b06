/* plant_numbers.h has the matrices of quell's LinearPlant.sampled(dt); example 10 writes it. The sums
 * have the order of quell.plants.linear, so that double precision gives the same bits. */
#include "plant.h"
#include "plant_numbers.h"

static const double transition[PLANT_ORDER][PLANT_ORDER] = PLANT_TRANSITION;
static const double input[PLANT_ORDER] = PLANT_INPUT, output[PLANT_ORDER] = PLANT_OUTPUT;
static const double disturbance[PLANT_ORDER] = PLANT_DISTURBANCE;
static double x[PLANT_ORDER];

void plant_reset(void)
{
    for (int i = 0; i < PLANT_ORDER; i++)
        x[i] = 0.0;
}

double plant_measure(void)
{
    double y = 0.0;
    for (int i = 0; i < PLANT_ORDER; i++)
        y += output[i] * x[i];
    return y;
}

void plant_advance(double u, double w)
{
    double next[PLANT_ORDER];
    for (int i = 0; i < PLANT_ORDER; i++) {
        double total = disturbance[i] * w;
        for (int j = 0; j < PLANT_ORDER; j++)
            total += transition[i][j] * x[j];
        next[i] = total + input[i] * u;
    }
    for (int i = 0; i < PLANT_ORDER; i++)
        x[i] = next[i];
}
