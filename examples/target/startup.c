/* Start of a Cortex-M4F or M7 without vendor code: vector table, memory, floating-point unit.
 *
 * target.ld gives the memory. A board of your own needs its addresses there, its clocks before
 * main(), and the interrupts that it uses in the table below, or in one of its own (stm32/board.c).
 */
#include <stdint.h>

extern uint32_t memory_stack[], memory_data_image[], memory_data[], memory_data_end[];
extern uint32_t memory_bss[], memory_bss_end[];
extern int main(int count, char **arguments);
/* Of newlib with --specs=rdimon.specs: printf and the result of main go to the debugger. */
extern void initialise_monitor_handles(void) __attribute__((weak));
extern void exit(int code) __attribute__((weak));

void reset_handler(void);
void stop_handler(void);
void hard_fault_handler(void) __attribute__((weak, alias("stop_handler")));
void systick_handler(void) __attribute__((weak, alias("stop_handler")));
void uart_receive_handler(void) __attribute__((weak, alias("stop_handler")));
void uart_transmit_handler(void) __attribute__((weak, alias("stop_handler")));

typedef void (*handler)(void);

/* Sixteen entries of the processor (ARM DDI 0403E, B1.5.2), then those of the board. */
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler handlers[15 + 2];
} vectors = {
    memory_stack,
    {
        reset_handler, stop_handler, hard_fault_handler, stop_handler, stop_handler, stop_handler,
        0, 0, 0, 0, stop_handler, stop_handler, 0, stop_handler, systick_handler,
        uart_receive_handler, uart_transmit_handler, /* interrupts 0 and 1 of the MPS2 boards */
    },
};

/* An unexpected interrupt or a fault: the watchdog of the hardware must bring the board back. */
void stop_handler(void)
{
    for (;;)
        ;
}

void reset_handler(void)
{
    /* Coprocessors 10 and 11 are the floating-point unit (B3.2.20); off after a reset. */
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20;
    __asm volatile("dsb\n\tisb");
    const uint32_t *from = memory_data_image;
    for (uint32_t *to = memory_data; to < memory_data_end; to++)
        *to = *from++;
    for (uint32_t *to = memory_bss; to < memory_bss_end; to++)
        *to = 0;
    if (initialise_monitor_handles)
        initialise_monitor_handles();
    static char *no_arguments[] = {0};
    int code = main(0, no_arguments);
    if (exit)
        exit(code);
    stop_handler();
}
