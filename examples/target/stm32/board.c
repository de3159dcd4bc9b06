/* A DC motor at an STM32F405, without vendor code: timer, encoder, PWM and serial line.
 *
 *     PB6, PB7   encoder A, B (TIM4)      PA6   PWM (TIM3) to EN of the bridge
 *     PA9, PA10  serial line (USART1)     PA5   direction, to PH of the bridge
 *
 * With the HAL, write the body of timer_handler() into HAL_TIM_PeriodElapsedCallback() and take the
 * calls of the page target_stm32; nothing else changes. Section numbers are those of RM0090.
 */
#include <stdint.h>
#include "motor.h"
#include "axis.h"

#ifndef TIMER_CLOCK
#define TIMER_CLOCK 16000000u /* of timers and serial line: HSI, as after a reset [Hz] */
#endif
#define BAUD 115200u
#define PWM_STEPS 800u /* 20 kHz at 16 MHz */

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define RCC(offset) REGISTER(0x40023800u + (offset))
#define PORT_A(offset) REGISTER(0x40020000u + (offset))
#define PORT_B(offset) REGISTER(0x40020400u + (offset))
#define TICK(offset) REGISTER(0x40000000u + (offset))    /* TIM2 */
#define PWM(offset) REGISTER(0x40000400u + (offset))     /* TIM3 */
#define ENCODER(offset) REGISTER(0x40000800u + (offset)) /* TIM4 */
#define WATCHDOG(offset) REGISTER(0x40003000u + (offset)) /* IWDG */
#define SERIAL(offset) REGISTER(0x40011000u + (offset))  /* USART1 */
/* Offsets of a timer (18.4) and of the serial line (30.6). */
enum { CR1 = 0x00, SMCR = 0x08, DIER = 0x0C, SR = 0x10, EGR = 0x14, CCMR1 = 0x18, CCER = 0x20 };
enum { CNT = 0x24, PSC = 0x28, ARR = 0x2C, CCR1 = 0x34 };
enum { STATUS = 0x00, DATA = 0x04, BRR = 0x08, CONTROL = 0x0C };
enum { TICK_INTERRUPT = 28, INTERRUPTS = 82 }; /* table 61 */

volatile uint32_t ticks, late_ticks;

#ifdef SIMULATED /* simulated_motor.c stands for what is behind the pins */
uint16_t encoder_count(void);
void motor_is_driven(float duty);
#else
static uint16_t encoder_count(void) { return (uint16_t)ENCODER(CNT); }
#define motor_is_driven(duty) ((void)0)
#endif

static void timer_handler(void)
{
    float duty;
    TICK(SR) = ~1u; /* first, so that a tick which comes meanwhile is seen below */
    duty = motor_tick(encoder_count());
    PORT_A(0x18) = duty < 0.0f ? 1u << 21 : 1u << 5; /* 8.4.7 */
    PWM(CCR1) = (uint32_t)((duty < 0.0f ? -duty : duty) * PWM_STEPS + 0.5f);
    motor_is_driven((duty < 0.0f ? -1.0f : 1.0f) * (float)PWM(CCR1) / PWM_STEPS);
    WATCHDOG(0x00) = 0xAAAAu; /* here and nowhere else: u has just been computed */
    ticks = ticks + 1u;
    late_ticks = late_ticks + (TICK(SR) & 1u); /* this sample took longer than one: too long */
}

/* The table of startup.c with the interrupt of the timer behind it. */
static void interrupts_start(void)
{
    static uint32_t vectors[128] __attribute__((aligned(512)));
    const volatile uint32_t *given = (const volatile uint32_t *)REGISTER(0xE000ED08u);
    for (uint32_t i = 0; i < 16u + INTERRUPTS; i++)
        vectors[i] = given[i < 16u ? i : 2u]; /* others stop, as a fault does */
    vectors[16 + TICK_INTERRUPT] = (uint32_t)timer_handler;
    REGISTER(0xE000ED08u) = (uint32_t)vectors; /* VTOR */
    REGISTER(0xE000E100u) = 1u << TICK_INTERRUPT;
}

static void board_start(void)
{
    RCC(0x30) |= 3u;      /* ports A and B */
    RCC(0x40) |= 7u;      /* TIM2, TIM3, TIM4 */
    RCC(0x44) |= 1u << 4; /* USART1 */
    /* Mode 2 is the alternate function, 1 an output (8.4.1); pull-ups for an open-collector encoder. */
    PORT_A(0x00) = (PORT_A(0x00) & ~0x3C3C00u) | 1u << 10 | 2u << 12 | 2u << 18 | 2u << 20;
    PORT_A(0x20) = (PORT_A(0x20) & ~(15u << 24)) | 2u << 24;
    PORT_A(0x24) = (PORT_A(0x24) & ~0xFF0u) | 0x770u;
    PORT_B(0x00) = (PORT_B(0x00) & ~(15u << 12)) | 10u << 12;
    PORT_B(0x0C) = (PORT_B(0x0C) & ~(15u << 12)) | 5u << 12;
    PORT_B(0x20) = (PORT_B(0x20) & ~(255u << 24)) | 34u << 24;

    ENCODER(ARR) = 0xFFFFu;
    ENCODER(CCMR1) = 0x3131u; /* both inputs, filtered over 8 clocks (18.3.12) */
    ENCODER(SMCR) = 3u;       /* counts each edge of A and B */
    ENCODER(CR1) = 1u;

    PWM(PSC) = 0u;
    PWM(ARR) = PWM_STEPS - 1u;
    PWM(CCR1) = 0u;
    PWM(CCMR1) = 0x68u; /* PWM mode 1, with preload (18.3.9) */
    PWM(CCER) = 1u;
    PWM(CR1) = 0x81u;

    SERIAL(BRR) = (TIMER_CLOCK + BAUD / 2u) / BAUD;
    SERIAL(CONTROL) = 0x200Cu;

    interrupts_start();
    TICK(PSC) = TIMER_CLOCK / 1000000u - 1u;
    TICK(ARR) = (uint32_t)(1.0e6 * AXIS_SAMPLE_TIME + 0.5) - 1u;
    TICK(EGR) = 1u; /* takes the prescaler */
    TICK(SR) = 0u;
    TICK(DIER) = 1u;
    TICK(CR1) = 1u;

    WATCHDOG(0x00) = 0x5555u; /* 21.4; some 10 ms at 32 kHz / 4 */
    WATCHDOG(0x04) = 0u;
    WATCHDOG(0x08) = 80u;
    WATCHDOG(0x00) = 0xCCCCu;
}

void board_put(char character)
{
    while (!(SERIAL(STATUS) & 1u << 7))
        ;
    SERIAL(DATA) = (uint32_t)(unsigned char)character;
}

int main(void)
{
    board_start();
    for (;;) {
        motor_poll();
        if (SERIAL(STATUS) & 1u << 5)
            motor_command((char)SERIAL(DATA));
    }
}
