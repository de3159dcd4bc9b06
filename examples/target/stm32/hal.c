/* The same motor in a project of STM32CubeMX: what board.c does, with the HAL.
 *
 * In CubeMX: TIM2 with the interrupt of its update each AXIS_SAMPLE_TIME, TIM3 channel 1 as PWM,
 * TIM4 in encoder mode TI1 and TI2 with period 65535, USART1 asynchronous, an output pin called
 * DIRECTION, IWDG. main.h is that of CubeMX. Call motor_begin() before the loop of main(), and
 * motor_loop() in it.
 */
#include "main.h"
#include "motor.h"

extern TIM_HandleTypeDef htim2, htim3, htim4;
extern UART_HandleTypeDef huart1;
extern IWDG_HandleTypeDef hiwdg;

void motor_begin(void);
void motor_loop(void);

void HAL_TIM_PeriodElapsedCallback(TIM_HandleTypeDef *timer)
{
    float duty;
    if (timer->Instance != TIM2)
        return;
    duty = motor_tick((uint16_t)__HAL_TIM_GET_COUNTER(&htim4));
    HAL_GPIO_WritePin(DIRECTION_GPIO_Port, DIRECTION_Pin, duty < 0.0f ? GPIO_PIN_SET : GPIO_PIN_RESET);
    __HAL_TIM_SET_COMPARE(&htim3, TIM_CHANNEL_1,
                          (uint32_t)((duty < 0.0f ? -duty : duty) * (float)(htim3.Init.Period + 1u) + 0.5f));
    (void)HAL_IWDG_Refresh(&hiwdg); /* here and nowhere else: u has just been computed */
}

void board_put(char character) { (void)HAL_UART_Transmit(&huart1, (uint8_t *)&character, 1, HAL_MAX_DELAY); }

void motor_begin(void)
{
    if (HAL_TIM_Encoder_Start(&htim4, TIM_CHANNEL_ALL) != HAL_OK ||
        HAL_TIM_PWM_Start(&htim3, TIM_CHANNEL_1) != HAL_OK || HAL_TIM_Base_Start_IT(&htim2) != HAL_OK)
        Error_Handler();
}

void motor_loop(void)
{
    uint8_t character;
    motor_poll();
    if (HAL_UART_Receive(&huart1, &character, 1, 0) == HAL_OK)
        motor_command((char)character);
}
