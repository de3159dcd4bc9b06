/* The serial line of the MPS2 boards (ARM CMSDK APB UART 0) with queues and interrupts.
 *
 * uart_send() never waits, and the interrupts take a few instructions: the timer's control step is
 * not delayed. Registers: ARM DDI 0479D, section 4.3.
 */
#include <stdbool.h>
#include <stdint.h>
#include "mps2.h"

#define UART ((volatile uint32_t *)0x40004000u)
#define SET_ENABLE (*(volatile uint32_t *)0xE000E100u)
#define PRIORITY ((volatile uint8_t *)0xE000E400u)
enum { DATA, STATE, CONTROL, INTERRUPT, DIVIDER };
enum { TRANSMIT_FULL = 1, RECEIVE_FULL = 2 };            /* bits of STATE */
enum { TRANSMIT_INTERRUPT = 1, RECEIVE_INTERRUPT = 2 };  /* bits of INTERRUPT */
enum { SIZE = 2048 }; /* bytes of a queue: a power of two */

static struct {
    volatile uint32_t head, tail; /* bytes put and taken, modulo 2^32 */
    uint8_t bytes[SIZE];
} received, waiting;

void uart_start(uint32_t baud)
{
    UART[DIVIDER] = CLOCK / baud;
    UART[CONTROL] = 0xF; /* transmitter and receiver on, with their interrupts */
    PRIORITY[0] = PRIORITY[1] = 0; /* higher than the timer: a byte lasts only 11 us at 921600 baud */
    SET_ENABLE = 3;
}

static void transmit(void)
{
    while (waiting.tail != waiting.head && !(UART[STATE] & TRANSMIT_FULL)) {
        UART[DATA] = waiting.bytes[waiting.tail % SIZE];
        waiting.tail++;
    }
}

void uart_transmit_handler(void)
{
    UART[INTERRUPT] = TRANSMIT_INTERRUPT;
    transmit();
}

void uart_receive_handler(void)
{
    UART[INTERRUPT] = RECEIVE_INTERRUPT;
    while (UART[STATE] & RECEIVE_FULL) {
        uint8_t byte = (uint8_t)UART[DATA];
        if (received.head - received.tail < SIZE) {
            received.bytes[received.head % SIZE] = byte;
            received.head++;
        }
    }
}

bool uart_receive(uint8_t *byte)
{
    if (received.tail == received.head)
        return false;
    *byte = received.bytes[received.tail % SIZE];
    received.tail++;
    return true;
}

/* A packet that does not fit is left out whole: the receiver counts it as lost. */
void uart_send(const uint8_t *data, int size)
{
    uint32_t masked = interrupts_off();
    if (SIZE - (waiting.head - waiting.tail) >= (uint32_t)size) {
        for (int i = 0; i < size; i++)
            waiting.bytes[waiting.head++ % SIZE] = data[i];
        transmit();
    }
    interrupts_restore(masked);
}
