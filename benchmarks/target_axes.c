/* Counts the instructions of a step of several axes, and of the single controllers of each axis.
 *
 * As target.c: the emulated timer counts instructions. samples.bin has r and y of a closed loop of
 * all axes that quell has simulated, SAMPLES of each axis one after the other, of the type REAL.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include "axes.h"
#include "one.h"
#include "two.h"
#include "three.h"

#define TIMER ((volatile uint32_t *)0xE000E010u) /* control, reload, value (ARM DDI 0403E, B3.3) */
#define TICKS_PER_INSTRUCTION 25.6
enum { AXES = 3 };

__asm(".section .rodata\n\t.balign 8\nsamples:\n\t.incbin \"samples.bin\"\n\t.previous");
extern const struct {
    REAL r[SAMPLES][AXES], y[SAMPLES][AXES];
} samples;

static axes_state axes;
static one_state one;
static two_state two;
static three_state three;

static inline uint32_t ticks_since(uint32_t before) { return (before - TIMER[2]) & 0xFFFFFFu; }

#define TICKS_OF(instructions)                                                                     \
    ({                                                                                             \
        uint32_t before, after;                                                                    \
        __asm volatile("ldr %0, [%2]\n\t" instructions "ldr %1, [%2]"                              \
                       : "=&r"(before), "=r"(after)                                                \
                       : "r"(TIMER + 2));                                                          \
        (before - after) & 0xFFFFFFu;                                                              \
    })

static volatile REAL kept;

int main(void)
{
    double together = 0.0, most = 0.0, alone = 0.0;

    TIMER[1] = 0xFFFFFF;
    TIMER[2] = 0;
    TIMER[0] = 5;
    while (TIMER[2] == 0)
        ;
    const double empty = TICKS_OF("");
    const double known = TICKS_OF(".rept 1000\n\tnop\n\t.endr\n\t") - empty;

    axes_init(&axes);
    int limited = 0;
    one_init(&one);
    two_init(&two);
    three_init(&three);
    for (int k = 0; k < SAMPLES; k++) {
        const REAL *r = samples.r[k], *y = samples.y[k];
        REAL u[AXES];
        uint32_t before = TIMER[2];
        axes_step(&axes, r, y, u);
        double count = (ticks_since(before) - empty) / TICKS_PER_INSTRUCTION;
        together += count;
        most = fmax(most, count);
        kept = u[0];
        limited += (axes_status(&axes) & (AXES_SATURATED | AXES_RATE_LIMITED)) != 0;
        REAL r1 = r[0], r2 = r[1], r3 = r[2], y1 = y[0], y2 = y[1], y3 = y[2];
        __asm volatile("" : "+t"(r1), "+t"(r2), "+t"(r3), "+t"(y1), "+t"(y2), "+t"(y3));
        before = TIMER[2];
        kept = one_step(&one, r1, y1);
        alone += (ticks_since(before) - empty) / TICKS_PER_INSTRUCTION;
        before = TIMER[2];
        kept = two_step(&two, r2, y2);
        alone += (ticks_since(before) - empty) / TICKS_PER_INSTRUCTION;
        before = TIMER[2];
        kept = three_step(&three, r3, y3);
        alone += (ticks_since(before) - empty) / TICKS_PER_INSTRUCTION;
    }
    printf("known %.9g\n", known / TICKS_PER_INSTRUCTION);
    printf("together %.9g\nmost %.9g\nalone %.9g\n", together / SAMPLES, most, alone / SAMPLES);
    printf("limited %.9g\n", (double)limited / SAMPLES);
    printf("state %lu\nstates %lu\n", (unsigned long)sizeof axes,
        (unsigned long)(sizeof one + sizeof two + sizeof three));
    exit(0);
}
