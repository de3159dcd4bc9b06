/* The controller @name@ of several signals in the loop of an Arduino.
 *
 * A timer interrupt is more exact; README.md has it. Replace pins and scales by those of your
 * sensors and drives.
 */
#include <@name@.h>

static @name@_state controller;
static unsigned long next_sample;
static const unsigned long sample_time = (unsigned long)(1e6 * @NAME@_SAMPLE_TIME + 0.5); /* [us] */

static const @real@ y_per_count = @one@; /* sensors: units of y */
static const @real@ counts_per_u = @one@; /* drives */
static @real@ r[@r_size@]@local_further@; /* references: replace them by your move */

void setup()
{
    @name@_init(&controller);
    next_sample = micros();
}

void loop()
{
    @real@ y[@y_size@], u[@NAME@_ACTUATORS];

    if ((long)(micros() - next_sample) < 0)
        return;
    next_sample += sample_time;

    for (int i = 0; i < @y_size@; i++)
        y[i] = y_per_count * (@real@)analogRead(A0 + i);
    @name@_step(&controller, r, y@further@, u);
    for (int k = 0; k < @NAME@_ACTUATORS; k++) {
        const int counts = constrain((int)(counts_per_u * u[k]), 0, 255);

        analogWrite(9 + k, counts);
        u[k] = (@real@)counts / counts_per_u;
    }
    @name@_applied(&controller, u);
}
