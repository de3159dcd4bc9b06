/* The controller @name@ in the loop of an Arduino.
 *
 * A timer interrupt is more exact; README.md has it. Replace the two scales by those of your
 * sensor and drive.
 */
#include <@name@.h>

static @name@_state controller;
static unsigned long next_sample;
static const unsigned long sample_time = (unsigned long)(1e6 * @NAME@_SAMPLE_TIME + 0.5); /* [us] */

static const @real@ y_per_count = @one@; /* sensor: units of y */
static const @real@ counts_per_u = @one@; /* drive */
@defined_reference@

void setup()
{
    @name@_init(&controller);
    next_sample = micros();
}

void loop()
{
    if ((long)(micros() - next_sample) < 0)
        return;
    next_sample += sample_time;

@next_reference@    const @real@ y = y_per_count * (@real@)analogRead(A0);
    const @real@ u = @name@_step(&controller, @reference@, y@derivatives@);
    const int counts = constrain((int)(counts_per_u * u), 0, 255);

    analogWrite(9, counts);
    @name@_applied(&controller, (@real@)counts / counts_per_u);
}
