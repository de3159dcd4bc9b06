/* What the examples use of the MPS2 boards AN386 (Cortex-M4F) and AN500 (Cortex-M7): timer,
 * interrupts, serial line. The timer and the interrupts are those of every Cortex-M. */
#ifndef MPS2_H
#define MPS2_H

#include <stdbool.h>
#include <stdint.h>

#define CLOCK 25000000u /* of processor and timer [Hz] */

/* Call systick_handler() every dt seconds (ARM DDI 0403E, B3.3). */
static inline void timer_start(double dt)
{
    *(volatile uint8_t *)0xE000ED23u = 0x40;                       /* priority: below the serial line */
    *(volatile uint32_t *)0xE000E014u = (uint32_t)(dt * CLOCK + 0.5) - 1; /* at most 2^24, 0.67 s */
    *(volatile uint32_t *)0xE000E018u = 0;
    *(volatile uint32_t *)0xE000E010u = 7;
}

/* Whether the timer has called for the next tick while its handler still runs. */
static inline bool timer_is_late(void)
{
    return (*(volatile uint32_t *)0xE000ED04u & 1u << 26) != 0;
}

static inline uint32_t interrupts_off(void)
{
    uint32_t masked;
    __asm volatile("mrs %0, primask\n\tcpsid i" : "=r"(masked) : : "memory");
    return masked;
}

static inline void interrupts_restore(uint32_t masked)
{
    __asm volatile("msr primask, %0" : : "r"(masked) : "memory");
}

void uart_start(uint32_t baud);
bool uart_receive(uint8_t *byte);
void uart_send(const uint8_t *data, int size); /* never waits */

#endif
