/* A controller of quell on the target, with telemetry over a serial line.
 *
 * It joins ../serial_device.c, which has frames and sessions, with an exported controller, "servo",
 * and an exported plant, "plant", in place of a drive. Commands are the targets of moves, which the
 * controller plans; every tick sends y as
 * the measurement and the rest as telemetry, in the order of the names that the loop gives to
 * quell.realtime.record_target.
 *
 *     idle, waiting   the plant rests, the controller is in its initial state
 *     live            r is the newest command
 *     tripped         no command for WATCHDOG ticks: r is held, the controller stays in charge
 */
#include "mps2.h"
#include "plant.h"
#include "servo.h"

#define DT SERVO_SAMPLE_TIME
#define U_MAX 100.0 /* largest reference [y-unit] */
#define QUELL_LOCK() uint32_t masked = interrupts_off()
#define QUELL_UNLOCK() interrupts_restore(masked)
#include "../serial_device.c"

/* Ticks that the simulated plant stands still if the loop has not answered its last measurement, so
 * that a late loop does not change the trajectory. With a drive it must be 0: a drive moves on. */
#ifndef MOST_WAIT
#define MOST_WAIT 0
#endif
#ifndef LOAD_AT
#define LOAD_AT 0 /* ticks until the plant is loaded */
#endif
#ifndef LOAD
#define LOAD 0.0
#endif

static servo_state servo;
static plant_state plant;
static double y, r;
static int32_t live; /* ticks since the first reference */
static volatile uint32_t ticks;

static void send_telemetry(double u)
{
    servo_estimate estimate = servo_get_estimate(&servo);
    uint32_t channel = 0;
    quell_telemetry(channel++, r);
    quell_telemetry(channel++, u);
    /* the channels of the controller in Python, in its order: those of one with moves and feedforward */
    quell_telemetry(channel++, estimate.r_shaped);
    for (size_t i = 0; i < sizeof estimate.x_hat / sizeof estimate.x_hat[0]; i++)
        quell_telemetry(channel++, estimate.x_hat[i]);
    quell_telemetry(channel++, estimate.f_residual);
    quell_telemetry(channel++, estimate.f_learned);
    quell_telemetry(channel++, estimate.status);
    quell_telemetry(channel++, estimate.u_feedforward);
}

double board_measure(void)
{
    y = plant_measure(&plant);
    return y;
}

void board_apply(double command)
{
    if (mode == IDLE || mode == WAITING) {
        servo_init(&servo);
        plant_init(&plant);
        live = 0;
        return;
    }
    if (mode == LIVE)
        r = command;
    double u = servo_step(&servo, r, y);
    const double load[PLANT_DISTURBANCES] = {live >= LOAD_AT ? LOAD : 0.0};
    plant_advance(&plant, live * DT, u, load);
    live++;
    send_telemetry(u);
}

void board_send(const uint8_t *data, int size) { uart_send(data, size); }
int64_t board_time(void) { return (int64_t)(1e9 * SERVO_SAMPLE_TIME) * ticks; }

void systick_handler(void)
{
    static int waited;
    if (!quell_answered() && waited < MOST_WAIT) {
        waited++;
        return;
    }
    waited = 0;
    ticks++;
    quell_tick();
}

int main(void)
{
    uint8_t byte;
    servo_init(&servo);
    plant_init(&plant);
    uart_start(921600);
    timer_start(SERVO_SAMPLE_TIME);
    for (;;) {
        while (uart_receive(&byte))
            quell_byte(byte);
        __asm volatile("wfi"); /* the timer, or a byte, goes on */
    }
}
