/* A linear plant, simulated on the target instead of a drive, with control signal u and load w:
 * x+ = transition x + input u + disturbance w, y = output x. */
#ifndef PLANT_H
#define PLANT_H

void plant_reset(void);
double plant_measure(void);
void plant_advance(double u, double w);

#endif
