/* A linear plant, simulated on the target instead of a drive: x+ = transition x + input u. */
#ifndef PLANT_H
#define PLANT_H

void plant_reset(void);
double plant_measure(void);
void plant_advance(double u);

#endif
