/* A DC motor with an encoder at an Arduino with 32 bits: UNO R4, Zero, Due, Nano 33, RP2040, Teensy.
 *
 *     pins 2, 3   encoder A, B        pin 9   PWM to EN of the bridge
 *                                     pin 7   direction, to PH of the bridge
 *
 * Copy motor.h and motor.c beside this file, and the folder that quell export wrote, with the name
 * axis, into the libraries of the sketchbook. See the page target_arduino.
 */
#include <Arduino.h>
#include <axis.h>
#include "motor.h"

const int PIN_A = 2, PIN_B = 3, PIN_PWM = 9, PIN_DIRECTION = 7;
const unsigned long PERIOD = (unsigned long)(1e6 * AXIS_SAMPLE_TIME + 0.5); /* [us] */

volatile uint16_t encoder; /* counts each edge of A and B */
volatile uint8_t before;
unsigned long next_tick, late;

/* From the states of A and B before and now: a step forwards, a step back, or none. */
void encoder_edge()
{
    static const int8_t steps[16] = {0, 1, -1, 0, -1, 0, 0, 1, 1, 0, 0, -1, 0, -1, 1, 0};
    const uint8_t now = (uint8_t)(digitalRead(PIN_A) << 1 | digitalRead(PIN_B));
    encoder = (uint16_t)(encoder + steps[before << 2 | now]);
    before = now;
}

extern "C" void board_put(char character) { Serial.write((uint8_t)character); }

void drive(float duty)
{
    digitalWrite(PIN_DIRECTION, duty < 0.0f ? HIGH : LOW);
    analogWrite(PIN_PWM, (int)(255.0f * (duty < 0.0f ? -duty : duty) + 0.5f));
}

void setup()
{
    pinMode(PIN_DIRECTION, OUTPUT);
    pinMode(PIN_PWM, OUTPUT);
    drive(0.0f);
    pinMode(PIN_A, INPUT_PULLUP);
    pinMode(PIN_B, INPUT_PULLUP);
    attachInterrupt(digitalPinToInterrupt(PIN_A), encoder_edge, CHANGE);
    attachInterrupt(digitalPinToInterrupt(PIN_B), encoder_edge, CHANGE);
    Serial.begin(115200);
    next_tick = micros();
}

void loop()
{
    uint16_t counter;
    if ((long)(micros() - next_tick) >= 0) {
        noInterrupts();
        counter = encoder;
        interrupts();
        drive(motor_tick(counter));
        next_tick += PERIOD;
        if ((long)(micros() - next_tick) >= 0) { /* a whole sample late: go on from now */
            late++;
            next_tick = micros() + PERIOD;
        }
    }
    motor_poll();
    if (Serial.available() > 0) {
        const char command = (char)Serial.read();
        if (command == 'l') { /* writing takes longer than a sample, and this loop has nobody else */
            motor_command('x');
            drive(0.0f);
        }
        motor_command(command);
        if (command == 'l')
            next_tick = micros();
    }
}
