/* Lets quell_tick() interrupt quell_byte() at each instruction of its last part, in the emulator.
 *
 * Each command has the value of its number, so that a tick sees whether number and value that it
 * finds belong together. The timer counts 25.6 ticks an instruction (-icount shift=10).
 */
#include <stdio.h>
#ifdef LOCKED
#define QUELL_LOCK() __asm volatile("cpsid i" : : : "memory")
#define QUELL_UNLOCK() __asm volatile("cpsie i" : : : "memory")
#endif
#define U_MAX 1e9
#include "serial_device.c"

#define TIMER ((volatile uint32_t *)0xE000E010u) /* control, reload, value (ARM DDI 0403E, B3.3) */

static uint8_t packet[sizeof(Frame) + 2];
static int length, building;
static volatile int ticks, wrong;

double board_measure(void) { return 0.0; }
int64_t board_time(void) { return 0; }
void board_apply(double u) { wrong += mode == LIVE && u != (double)heard; }

void board_send(const uint8_t *data, int size)
{
    if (building) {
        memcpy(packet, data, (size_t)size);
        length = size;
    }
}

/* Build a packet of the other side, which answers the last measurement. */
static void build(uint8_t kind, uint32_t number, double value)
{
    uint32_t own = heard;
    heard = sent;
    building = 1;
    send_frame(kind, 7, number, value, 0);
    building = 0;
    heard = own;
}

void systick_handler(void)
{
    TIMER[0] = 0;
    quell_tick();
    ticks++;
}

static void feed(uint32_t after)
{
    int before = ticks;
    TIMER[1] = after;
    TIMER[2] = 0;
    TIMER[0] = 7;
    for (int i = 0; i < length; i++)
        quell_byte(packet[i]);
    while (ticks == before)
        ;
}

int main(void)
{
    uint32_t number = 0;
    build(HELLO, 0, DT);
    feed(1000000);
    build(COMMAND, ++number, 1.0);
    TIMER[1] = 0xFFFFFF;
    TIMER[2] = 0;
    TIMER[0] = 5;
    for (int i = 0; i < length; i++)
        quell_byte(packet[i]);
    uint32_t whole = 0xFFFFFF - TIMER[2];
    quell_tick();
    for (uint32_t after = whole - whole / 8; after < whole + 1000; after += 13) {
        number++;
        build(COMMAND, number, number);
        feed(after);
        quell_tick();
    }
    printf("%d ticks, %d wrong, live %d\n", ticks, wrong, mode == LIVE);
    return 0;
}
