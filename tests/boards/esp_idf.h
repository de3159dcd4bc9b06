/* What examples/target/esp32 uses of ESP-IDF 5.3, with the types of its headers, to compile it. */
#pragma once
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>

typedef int esp_err_t;
#define ESP_ERROR_CHECK(call) do { if ((call) != 0) abort(); } while (0)
#define IRAM_ATTR

/* FreeRTOS */
typedef int BaseType_t;
typedef unsigned UBaseType_t;
typedef uint32_t TickType_t;
typedef struct tskTaskControlBlock *TaskHandle_t;
typedef void (*TaskFunction_t)(void *);
#define pdFALSE 0
#define pdTRUE 1
#define portMAX_DELAY 0xffffffffu
#define configMAX_PRIORITIES 25
BaseType_t xTaskCreatePinnedToCore(TaskFunction_t, const char *, uint32_t, void *, UBaseType_t,
                                   TaskHandle_t *, BaseType_t);
BaseType_t xPortGetCoreID(void);
void vTaskNotifyGiveFromISR(TaskHandle_t, BaseType_t *);
uint32_t ulTaskNotifyTake(BaseType_t, TickType_t);
void vTaskDelay(TickType_t);

/* driver/gptimer.h */
typedef struct gptimer_t *gptimer_handle_t;
typedef struct { uint64_t count_value, alarm_value; } gptimer_alarm_event_data_t;
typedef bool (*gptimer_alarm_cb_t)(gptimer_handle_t, const gptimer_alarm_event_data_t *, void *);
enum { GPTIMER_CLK_SRC_DEFAULT, GPTIMER_COUNT_UP };
typedef struct {
    int clk_src, direction;
    uint32_t resolution_hz;
    int intr_priority;
    struct { uint32_t intr_shared : 1; } flags;
} gptimer_config_t;
typedef struct { gptimer_alarm_cb_t on_alarm; } gptimer_event_callbacks_t;
typedef struct {
    uint64_t alarm_count, reload_count;
    struct { uint32_t auto_reload_on_alarm : 1; } flags;
} gptimer_alarm_config_t;
esp_err_t gptimer_new_timer(const gptimer_config_t *, gptimer_handle_t *);
esp_err_t gptimer_set_alarm_action(gptimer_handle_t, const gptimer_alarm_config_t *);
esp_err_t gptimer_register_event_callbacks(gptimer_handle_t, const gptimer_event_callbacks_t *, void *);
esp_err_t gptimer_enable(gptimer_handle_t);
esp_err_t gptimer_start(gptimer_handle_t);

/* driver/pulse_cnt.h */
typedef struct pcnt_unit_t *pcnt_unit_handle_t;
typedef struct pcnt_chan_t *pcnt_channel_handle_t;
enum { PCNT_CHANNEL_EDGE_ACTION_INCREASE, PCNT_CHANNEL_EDGE_ACTION_DECREASE };
enum { PCNT_CHANNEL_LEVEL_ACTION_KEEP, PCNT_CHANNEL_LEVEL_ACTION_INVERSE };
typedef struct {
    int low_limit, high_limit, intr_priority;
    struct { uint32_t accum_count : 1; } flags;
} pcnt_unit_config_t;
typedef struct { int edge_gpio_num, level_gpio_num; } pcnt_chan_config_t;
typedef struct { uint32_t max_glitch_ns; } pcnt_glitch_filter_config_t;
esp_err_t pcnt_new_unit(const pcnt_unit_config_t *, pcnt_unit_handle_t *);
esp_err_t pcnt_unit_set_glitch_filter(pcnt_unit_handle_t, const pcnt_glitch_filter_config_t *);
esp_err_t pcnt_new_channel(pcnt_unit_handle_t, const pcnt_chan_config_t *, pcnt_channel_handle_t *);
esp_err_t pcnt_channel_set_edge_action(pcnt_channel_handle_t, int, int);
esp_err_t pcnt_channel_set_level_action(pcnt_channel_handle_t, int, int);
esp_err_t pcnt_unit_add_watch_point(pcnt_unit_handle_t, int);
esp_err_t pcnt_unit_enable(pcnt_unit_handle_t);
esp_err_t pcnt_unit_clear_count(pcnt_unit_handle_t);
esp_err_t pcnt_unit_start(pcnt_unit_handle_t);
esp_err_t pcnt_unit_get_count(pcnt_unit_handle_t, int *);

/* driver/ledc.h, driver/gpio.h */
enum { LEDC_LOW_SPEED_MODE, LEDC_CHANNEL_0, LEDC_TIMER_0, LEDC_AUTO_CLK, GPIO_MODE_OUTPUT };
typedef struct { int speed_mode, duty_resolution, timer_num; uint32_t freq_hz; int clk_cfg; } ledc_timer_config_t;
typedef struct { int gpio_num, speed_mode, channel, intr_type, timer_sel; uint32_t duty; int hpoint; } ledc_channel_config_t;
esp_err_t ledc_timer_config(const ledc_timer_config_t *);
esp_err_t ledc_channel_config(const ledc_channel_config_t *);
esp_err_t ledc_set_duty(int, int, uint32_t);
esp_err_t ledc_update_duty(int, int);
esp_err_t gpio_set_direction(int, int);
esp_err_t gpio_set_level(int, uint32_t);
