/* What examples/target/stm32/hal.c uses of the HAL of STM32F4, and of CubeMX, to compile it. */
#pragma once
#include <stdint.h>

typedef enum { HAL_OK, HAL_ERROR } HAL_StatusTypeDef;
typedef enum { GPIO_PIN_RESET, GPIO_PIN_SET } GPIO_PinState;
typedef struct { volatile uint32_t CNT, CCR1; } TIM_TypeDef;
typedef struct { TIM_TypeDef *Instance; struct { uint32_t Prescaler, CounterMode, Period; } Init; } TIM_HandleTypeDef;
typedef struct { int none; } UART_HandleTypeDef, IWDG_HandleTypeDef, GPIO_TypeDef;
#define TIM2 ((TIM_TypeDef *)0x40000000u)
#define DIRECTION_GPIO_Port ((GPIO_TypeDef *)0x40020000u)
#define DIRECTION_Pin 0x20u
#define TIM_CHANNEL_1 0u
#define TIM_CHANNEL_ALL 0x3Cu
#define HAL_MAX_DELAY 0xFFFFFFFFu
#define __HAL_TIM_GET_COUNTER(timer) ((timer)->Instance->CNT)
#define __HAL_TIM_SET_COMPARE(timer, channel, value) ((void)(channel), (timer)->Instance->CCR1 = (value))
HAL_StatusTypeDef HAL_TIM_Encoder_Start(TIM_HandleTypeDef *, uint32_t);
HAL_StatusTypeDef HAL_TIM_PWM_Start(TIM_HandleTypeDef *, uint32_t);
HAL_StatusTypeDef HAL_TIM_Base_Start_IT(TIM_HandleTypeDef *);
HAL_StatusTypeDef HAL_UART_Transmit(UART_HandleTypeDef *, const uint8_t *, uint16_t, uint32_t);
HAL_StatusTypeDef HAL_UART_Receive(UART_HandleTypeDef *, uint8_t *, uint16_t, uint32_t);
HAL_StatusTypeDef HAL_IWDG_Refresh(IWDG_HandleTypeDef *);
void HAL_GPIO_WritePin(GPIO_TypeDef *, uint16_t, GPIO_PinState);
void HAL_TIM_PeriodElapsedCallback(TIM_HandleTypeDef *);
void Error_Handler(void);
