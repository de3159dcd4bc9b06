/* A DC motor with an encoder at an ESP32, with ESP-IDF 5.
 *
 *     GPIO 18, 19   encoder A, B (PCNT)     GPIO 25   PWM (LEDC) to EN of the bridge
 *                                           GPIO 26   direction, to PH of the bridge
 *
 * The ESP32 has no floating-point unit in interrupts: the timer wakes a task of high priority. It
 * runs on the core of app_main, so that it interrupts that one, and never runs beside it.
 */
#include <stdio.h>
#include "axis.h"
#include "driver/gpio.h"
#include "driver/gptimer.h"
#include "driver/ledc.h"
#include "driver/pulse_cnt.h"
#include "esp_attr.h"
#include "esp_err.h"
#include "freertos/FreeRTOS.h"
#include "freertos/task.h"
#include "motor.h"

enum { PIN_A = 18, PIN_B = 19, PIN_PWM = 25, PIN_DIRECTION = 26 };
#define PWM_BITS 11
#define PWM_FREQUENCY 20000

static TaskHandle_t control;
static pcnt_unit_handle_t encoder;
volatile uint32_t ticks, late_ticks;

static bool IRAM_ATTR timer_alarm(gptimer_handle_t timer, const gptimer_alarm_event_data_t *event,
                                  void *context)
{
    BaseType_t woken = pdFALSE;
    (void)timer;
    (void)event;
    (void)context;
    vTaskNotifyGiveFromISR(control, &woken);
    return woken == pdTRUE;
}

static void drive(float duty)
{
    const float size = duty < 0.0f ? -duty : duty;
    (void)gpio_set_level(PIN_DIRECTION, duty < 0.0f);
    (void)ledc_set_duty(LEDC_LOW_SPEED_MODE, LEDC_CHANNEL_0,
                        (uint32_t)(size * (float)(1 << PWM_BITS) + 0.5f));
    (void)ledc_update_duty(LEDC_LOW_SPEED_MODE, LEDC_CHANNEL_0);
}

static void control_task(void *context)
{
    (void)context;
    for (;;) {
        int count = 0;
        const uint32_t waiting = ulTaskNotifyTake(pdTRUE, portMAX_DELAY);
        (void)pcnt_unit_get_count(encoder, &count);
        drive(motor_tick((uint16_t)count));
        ticks = ticks + 1u;
        late_ticks = late_ticks + waiting - 1u; /* a sample took longer than one: too long */
    }
}

static void encoder_start(void)
{
    const pcnt_unit_config_t unit = {
        .low_limit = -32768, .high_limit = 32767, .flags = {.accum_count = 1}};
    const pcnt_glitch_filter_config_t filter = {.max_glitch_ns = 1000};
    const pcnt_chan_config_t first = {.edge_gpio_num = PIN_A, .level_gpio_num = PIN_B};
    const pcnt_chan_config_t second = {.edge_gpio_num = PIN_B, .level_gpio_num = PIN_A};
    pcnt_channel_handle_t a, b;
    ESP_ERROR_CHECK(pcnt_new_unit(&unit, &encoder));
    ESP_ERROR_CHECK(pcnt_unit_set_glitch_filter(encoder, &filter));
    ESP_ERROR_CHECK(pcnt_new_channel(encoder, &first, &a));
    ESP_ERROR_CHECK(pcnt_new_channel(encoder, &second, &b));
    ESP_ERROR_CHECK(pcnt_channel_set_edge_action(a, PCNT_CHANNEL_EDGE_ACTION_DECREASE,
                                                 PCNT_CHANNEL_EDGE_ACTION_INCREASE));
    ESP_ERROR_CHECK(pcnt_channel_set_level_action(a, PCNT_CHANNEL_LEVEL_ACTION_KEEP,
                                                  PCNT_CHANNEL_LEVEL_ACTION_INVERSE));
    ESP_ERROR_CHECK(pcnt_channel_set_edge_action(b, PCNT_CHANNEL_EDGE_ACTION_INCREASE,
                                                 PCNT_CHANNEL_EDGE_ACTION_DECREASE));
    ESP_ERROR_CHECK(pcnt_channel_set_level_action(b, PCNT_CHANNEL_LEVEL_ACTION_KEEP,
                                                  PCNT_CHANNEL_LEVEL_ACTION_INVERSE));
    /* Without these the count does not go on past the limits. */
    ESP_ERROR_CHECK(pcnt_unit_add_watch_point(encoder, unit.low_limit));
    ESP_ERROR_CHECK(pcnt_unit_add_watch_point(encoder, unit.high_limit));
    ESP_ERROR_CHECK(pcnt_unit_enable(encoder));
    ESP_ERROR_CHECK(pcnt_unit_clear_count(encoder));
    ESP_ERROR_CHECK(pcnt_unit_start(encoder));
}

static void pwm_start(void)
{
    const ledc_timer_config_t timer = {.speed_mode = LEDC_LOW_SPEED_MODE,
                                       .duty_resolution = PWM_BITS,
                                       .timer_num = LEDC_TIMER_0,
                                       .freq_hz = PWM_FREQUENCY,
                                       .clk_cfg = LEDC_AUTO_CLK};
    const ledc_channel_config_t channel = {.gpio_num = PIN_PWM,
                                           .speed_mode = LEDC_LOW_SPEED_MODE,
                                           .channel = LEDC_CHANNEL_0,
                                           .timer_sel = LEDC_TIMER_0,
                                           .duty = 0};
    ESP_ERROR_CHECK(gpio_set_direction(PIN_DIRECTION, GPIO_MODE_OUTPUT));
    ESP_ERROR_CHECK(ledc_timer_config(&timer));
    ESP_ERROR_CHECK(ledc_channel_config(&channel));
}

static void timer_begin(void)
{
    const gptimer_config_t config = {.clk_src = GPTIMER_CLK_SRC_DEFAULT,
                                     .direction = GPTIMER_COUNT_UP,
                                     .resolution_hz = 1000000};
    const gptimer_alarm_config_t alarm = {
        .alarm_count = (uint64_t)(1.0e6 * AXIS_SAMPLE_TIME + 0.5),
        .reload_count = 0,
        .flags = {.auto_reload_on_alarm = true}};
    const gptimer_event_callbacks_t callbacks = {.on_alarm = timer_alarm};
    gptimer_handle_t timer;
    ESP_ERROR_CHECK(gptimer_new_timer(&config, &timer));
    ESP_ERROR_CHECK(gptimer_set_alarm_action(timer, &alarm));
    ESP_ERROR_CHECK(gptimer_register_event_callbacks(timer, &callbacks, NULL));
    ESP_ERROR_CHECK(gptimer_enable(timer));
    ESP_ERROR_CHECK(gptimer_start(timer));
}

void board_put(char character) { (void)putchar(character); }

void app_main(void)
{
    pwm_start();
    encoder_start();
    (void)xTaskCreatePinnedToCore(control_task, "control", 4096, NULL, configMAX_PRIORITIES - 2,
                                  &control, xPortGetCoreID());
    timer_begin();
    for (;;) {
        int received;
        motor_poll();
        clearerr(stdin); /* no character yet is no end of the file */
        while ((received = getchar()) != EOF)
            motor_command((char)received);
        (void)fflush(stdout);
        vTaskDelay(1);
    }
}
