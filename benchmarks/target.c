/* Counts the instructions and the stack of each control step of an exported controller.
 *
 * It runs in the emulator with -icount shift=10: an instruction takes 1024 ns of the emulated time,
 * 25.6 ticks of the timer at 25 MHz, so that the timer counts instructions. A loop of known length
 * checks this. The stack is painted before the steps and searched for the deepest change after them.
 *
 * samples.bin has r and y of a closed loop that quell has simulated, of the type REAL, and its u in
 * double precision, SAMPLES of each.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include "counted.h"

#define TIMER ((volatile uint32_t *)0xE000E010u) /* control, reload, value (ARM DDI 0403E, B3.3) */
#define TICKS_PER_INSTRUCTION 25.6
#define PAINT 0x5AFE5AFEu
enum { PAINTED = 16384 }; /* bytes below the stack pointer */

__asm(".section .rodata\n\t.balign 8\nsamples:\n\t.incbin \"samples.bin\"\n\t.previous");
extern const struct {
    REAL r[SAMPLES], y[SAMPLES];
    double u[SAMPLES];
} samples;

static counted_state state;
static uint32_t counts[SAMPLES];
static unsigned char image[COUNTED_MEMORY_SIZE];
static REAL u[SAMPLES];

static inline uint32_t ticks_since(uint32_t before) { return (before - TIMER[2]) & 0xFFFFFFu; }

/* Ticks from a reading of the timer to the next, with some instructions between them. */
#define TICKS_OF(instructions)                                                                     \
    ({                                                                                             \
        uint32_t before, after;                                                                    \
        __asm volatile("ldr %0, [%2]\n\t" instructions "ldr %1, [%2]"                              \
                       : "=&r"(before), "=r"(after)                                                \
                       : "r"(TIMER + 2));                                                          \
        (before - after) & 0xFFFFFFu;                                                              \
    })

__attribute__((noinline)) static uint32_t run(void)
{
    uint32_t stack;
    __asm volatile("mov %0, sp" : "=r"(stack));
    volatile uint32_t *top = (volatile uint32_t *)stack;
    for (int i = 1; i <= PAINTED / 4; i++)
        top[-i] = PAINT;
    for (int k = 0; k < SAMPLES; k++) {
        REAL now = samples.r[k], measured = samples.y[k];
        __asm volatile("" : "+t"(now), "+t"(measured)); /* loaded before the clock is read */
        uint32_t before = TIMER[2];
        u[k] = counted_step(&state, now, measured);
        counts[k] = ticks_since(before);
    }
    for (int i = PAINTED / 4; i >= 1; i--)
        if (top[-i] != PAINT)
            return (uint32_t)i * 4;
    return 0;
}

int main(void)
{
    TIMER[1] = 0xFFFFFF;
    TIMER[2] = 0;
    TIMER[0] = 5; /* on, with the processor's clock, without interrupt */
    while (TIMER[2] == 0)
        ;
    double empty = TICKS_OF(""), known = TICKS_OF(".rept 1000\n\tnop\n\t.endr\n\t") - empty;
    counted_init(&state);
    uint32_t stack = run();
    uint32_t before = TIMER[2];
    counted_save(&state, image);
    double save = (ticks_since(before) - empty) / TICKS_PER_INSTRUCTION;
    before = TIMER[2];
    int loaded = counted_load(&state, image, sizeof image, true);
    double load = (ticks_since(before) - empty) / TICKS_PER_INSTRUCTION;
    double sum = 0.0, most = 0.0, error = 0.0, square = 0.0;
    for (int k = 0; k < SAMPLES; k++) {
        double count = (counts[k] - empty) / TICKS_PER_INSTRUCTION;
        sum += count;
        most = fmax(most, count);
        error += (u[k] - samples.u[k]) * (u[k] - samples.u[k]);
        square += samples.u[k] * samples.u[k];
    }
    printf("known %.9g\nmean %.9g\nmost %.9g\n", known / TICKS_PER_INSTRUCTION, sum / SAMPLES, most);
    printf("stack %lu\nstate %lu\n", (unsigned long)stack, (unsigned long)sizeof state);
    printf("save %.9g\nload %.9g\n", save, loaded ? load : -1.0);
    printf("image %lu\n", (unsigned long)sizeof image);
    printf("difference %.9g\n", sqrt(error / square));
    exit(0);
}
