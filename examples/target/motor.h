/* A motor with an encoder around an exported controller, "axis", for any board.
 *
 * The board calls motor_tick() in its timer interrupt and motor_poll() in its main loop; it has
 * board_put() alone to write. Pages of the documentation: target_stm32, target_arduino, target_esp32.
 */
#ifndef MOTOR_H
#define MOTOR_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- Your machine; give other values to the compiler, as -DMOTOR_COUNTS=4096 ---- */

#ifndef MOTOR_COUNTS
#define MOTOR_COUNTS 2048 /* of the encoder in a revolution: four for each of its lines */
#endif
#ifndef MOTOR_SUPPLY
#define MOTOR_SUPPLY 12.0f /* of the bridge: the voltage of the whole duty [V] */
#endif
#ifndef MOTOR_TRAVEL
#define MOTOR_TRAVEL 20.0f /* from where it stood at the start; beyond it the drive is off [rad] */
#endif
#ifndef MOTOR_TRY
#define MOTOR_TRY 1.5f /* of the first motion, which finds the direction of the encoder [V] */
#endif
#ifndef MOTOR_LOG
#define MOTOR_LOG 1500 /* samples of 12 bytes */
#endif

typedef enum {
    MOTOR_OFF,    /* no voltage; waits for the command b */
    MOTOR_TRIES,  /* MOTOR_TRY until it has moved */
    MOTOR_SLOWS,  /* no voltage until it stands */
    MOTOR_STANDS, /* motor_poll() starts the controller */
    MOTOR_RUNS,   /* the controller has it */
    MOTOR_FAULT   /* no voltage until the next command b; motor_fault() says why */
} motor_mode;

/* In the timer interrupt, each AXIS_SAMPLE_TIME. counter is that of the encoder, which may
 * overflow at 16 bits; return the duty, from -1 to 1. */
float motor_tick(uint16_t counter);

/* In the main loop, as often as you like: what takes longer than a sample. */
void motor_poll(void);

/* In the main loop, for each character that was received:
 *     b   begin: try the direction, then hold the angle
 *     + - a revolution further, or back
 *     x   off
 *     l   write the log, t,r,u,y in SI units, for quell identify and quell b0
 *     ?   write the mode and the angle */
void motor_command(char command);

motor_mode motor_state(void);
const char *motor_fault(void); /* empty without one */
float motor_angle(void);       /* from where the controller was started [rad] */

/* Write a character; may wait. */
void board_put(char character);

#ifdef __cplusplus
}
#endif

#endif
