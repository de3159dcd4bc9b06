/* What is behind the pins, in the emulator: an exported motor, "plant", its encoder and its user.
 *
 * The voltage is that of the registers. The user begins, moves by a revolution to and fro, loads the
 * shaft, asks for the log and goes; FAULT makes the encoder count down, the motor stay off, or the
 * shaft block.
 */
#include "motor.h"
#include "plant.h"

enum { REVERSED = 1, DEAD = 2, BLOCKED = 3 };
#ifndef FAULT
#define FAULT 0
#endif
#ifndef LOAD
#define LOAD 0.0
#endif
/* Samples of the controller: a move to and fro each EVERY, the load, the end. */
enum { MOVE = 50, EVERY = 200, MOVES = 5, LOADED = 1050, END = 1500 };

static plant_state plant;
static int32_t sample, waited;
extern volatile uint32_t late_ticks;

static void user(void);

uint16_t encoder_count(void)
{
    static int32_t started;
    double turns;
    if (!started) {
        plant_init(&plant);
        started = 1;
    }
    turns = plant_measure(&plant) / 6.283185307179586;
    return (uint16_t)(int32_t)((FAULT == REVERSED ? -1.0 : 1.0) * turns * MOTOR_COUNTS + 0.5 + 65536.0);
}

void motor_is_driven(float duty)
{
    const double load[PLANT_DISTURBANCES] = {motor_state() == MOTOR_RUNS && sample >= LOADED ? LOAD : 0.0};
    const double u = FAULT == DEAD || (FAULT == BLOCKED && sample >= MOVE) ? 0.0 : duty * MOTOR_SUPPLY;
    plant_advance(&plant, 0.0, u, load);
    if (motor_state() == MOTOR_RUNS)
        sample++;
    user();
}

/* Of the debugger: end the emulation (ARM DUI 0471, SYS_EXIT). */
static void leave(void)
{
    register uint32_t call __asm("r0") = 0x18u;
    register uint32_t reason __asm("r1") = 0x20026u;
    __asm volatile("bkpt 0xAB" : : "r"(call), "r"(reason));
}

static void user(void)
{
    waited++;
    if (waited == 20)
        motor_command('b');
    for (int32_t i = 0; i < MOVES && motor_state() == MOTOR_RUNS; i++)
        if (sample == MOVE + i * EVERY)
            motor_command(i % 2 ? '-' : '+');
    if (sample == END || motor_state() == MOTOR_FAULT || waited > 4000) {
        motor_command('?');
        motor_command('l');
        leave();
    }
}
