// A stand-in for an Arduino with a motor, its bridge and its encoder, and a user at the serial line.
// Its time is that of the samples: in each the plant goes on, edge by edge, and loop() has its turns.

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include "plant.h"

enum { LOW, HIGH, INPUT_PULLUP, OUTPUT, CHANGE };
static unsigned long now; // [us]
static int pins[32], duty;
static void (*edge)();
static const char *input = "";

static void pinMode(int, int) {}
static int digitalRead(int pin) { return pins[pin]; }
static void digitalWrite(int pin, int value) { pins[pin] = value; }
static void analogWrite(int, int value) { duty = value; }
static int digitalPinToInterrupt(int pin) { return pin; }
static void attachInterrupt(int, void (*handler)(), int) { edge = handler; }
static void noInterrupts() {}
static void interrupts() {}
static unsigned long micros() { return now; }
static struct
{
    void begin(long) {}
    void write(std::uint8_t character) { std::putchar(character); }
    int available() { return *input != 0; }
    int read() { return *input++; }
} Serial;

#include SKETCH

int main()
{
    static const int gray[4][2] = {{0, 0}, {0, 1}, {1, 1}, {1, 0}};
    plant_state plant;
    long count = 0;
    plant_init(&plant);
    setup();
    for (int k = 0; k < 1500; k++) {
        if (k == 20)
            input = "b";
        if (k == 600)
            input = "+";
        if (k == 1400)
            input = "?l";
        const double load[PLANT_DISTURBANCES] = {0.0};
        for (int turns = 0; turns < 5; turns++)
            loop();
        plant_advance(&plant, 0.0, (pins[7] ? -12.0 : 12.0) * duty / 255.0, load);
        const long measured = std::lround(plant_measure(&plant) / 6.283185307179586 * 2048.0);
        while (count != measured) {
            count += measured > count ? 1 : -1;
            pins[PIN_A] = gray[count & 3][0];
            pins[PIN_B] = gray[count & 3][1];
            edge();
        }
        now += 1000;
    }
    return late == 0 && duty == 0 ? 0 : 1;
}
