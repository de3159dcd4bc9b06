/* See motor.h. All that both contexts use is one word, or is used by one of them in each mode. */
#include "motor.h"
#include "axis.h"

/* Before the mode changes, all that the other context then reads is in memory. */
#define WRITTEN() __asm volatile("" : : : "memory")

#define ANGLE_OF_COUNT (6.28318531f / MOTOR_COUNTS) /* [rad] */
#define TICKS(seconds) ((int32_t)((seconds) / AXIS_SAMPLE_TIME + 0.5))
#define MOVED (MOTOR_COUNTS / 100 + 4) /* counts that are a motion, and no noise of the encoder */
#define LONGEST_TRY TICKS(0.2)         /* a motor that has not moved then is blocked, or not there */
#define STILL TICKS(0.1)               /* without a count: it stands */
#define LONGEST_PUSH TICKS(0.5)        /* at a limit of u without a count: something is in the way */

typedef struct {
    int32_t count; /* from the angle zero */
    float u;       /* [V] */
    int16_t turn;  /* the target, in revolutions */
} sample;

static axis_state axis;
static volatile motor_mode mode;
static const char *volatile fault = "";
static volatile int16_t turn; /* the target; the main loop writes it */
static volatile int32_t count;
static int32_t begin;         /* the count that is the angle zero: where it was tried, then where it stood */
static int32_t waited, quiet; /* ticks in this mode, and ticks without a count */
static sample samples[MOTOR_LOG];
static volatile int32_t logged;

static float angle(int32_t counts) { return ANGLE_OF_COUNT * (float)counts; }
static float target(int16_t turns) { return angle((int32_t)turns * MOTOR_COUNTS); }
static int32_t position(void) { return (int32_t)((uint32_t)count - (uint32_t)begin); }

static float failed(const char *reason)
{
    fault = reason;
    mode = MOTOR_FAULT;
    return 0.0f;
}

static float try_direction(void)
{
    if (position() >= MOVED) {
        waited = quiet = 0;
        mode = MOTOR_SLOWS;
        return 0.0f;
    }
    if (position() <= -MOVED)
        return failed("the encoder counts down under a positive voltage: change A and B, or the motor's wires");
    if (++waited > LONGEST_TRY)
        return failed("the motor does not move, or the encoder does not count: look at supply and wires");
    return MOTOR_TRY;
}

static float run(void)
{
    const int16_t turns = turn;
    const float y = angle(position());
    const float u = axis_step(&axis, target(turns), y);
    const bool pushes = (axis_status(&axis) & AXIS_SATURATED) != 0;
    waited = pushes && quiet > 0 ? waited + 1 : 0;
    if (waited > LONGEST_PUSH)
        return failed("u is at its limit and nothing moves: it is blocked");
    if (y > MOTOR_TRAVEL || y < -MOTOR_TRAVEL)
        return failed("it is beyond MOTOR_TRAVEL");
    if (logged < MOTOR_LOG) {
        const sample now = {position(), u, turns};
        samples[logged] = now;
        logged = logged + 1;
    }
    return u;
}

float motor_tick(uint16_t counter)
{
    static uint16_t before;
    static bool known;
    const int16_t moved = known ? (int16_t)(uint16_t)(counter - before) : 0; /* past an overflow, too */
    float u = 0.0f;
    before = counter;
    known = true;
    count = (int32_t)((uint32_t)count + (uint32_t)(int32_t)moved);
    if (moved != 0)
        quiet = 0;
    else if (quiet <= LONGEST_PUSH)
        quiet++;
    switch (mode) {
    case MOTOR_TRIES:
        u = try_direction();
        break;
    case MOTOR_SLOWS:
        if (quiet > STILL)
            mode = MOTOR_STANDS;
        break;
    case MOTOR_RUNS:
        u = run();
        break;
    default:
        break;
    }
    u /= MOTOR_SUPPLY;
    return u > 1.0f ? 1.0f : u < -1.0f ? -1.0f : u;
}

void motor_poll(void)
{
    if (mode != MOTOR_STANDS) /* the interrupt leaves the controller alone in this mode */
        return;
    begin = count;
    turn = 0;
    logged = 0;
    waited = 0;
    axis_init(&axis);
    axis_start(&axis, 0.0f, 0.0f, 0.0f); /* thousands of steps: not in the interrupt */
    WRITTEN();
    mode = MOTOR_RUNS;
}

/* ---- Commands and text ---- */

static void put_text(const char *text)
{
    while (*text != '\0')
        board_put(*text++);
}

/* Write a number with six decimals, without the printf of a C library. */
static void put_number(float value)
{
    char digits[12];
    int32_t n = 0;
    const bool negative = value < 0.0f;
    float size = negative ? -value : value;
    uint32_t whole, millionths;
    if (!(size < 4.0e9f)) {
        put_text("nan");
        return;
    }
    whole = (uint32_t)size;
    millionths = (uint32_t)((size - (float)whole) * 1.0e6f + 0.5f);
    if (millionths > 999999u) {
        millionths = 0u;
        whole++;
    }
    if (negative)
        board_put('-');
    do
        digits[n++] = (char)('0' + whole % 10u);
    while ((whole /= 10u) != 0u);
    while (n > 0)
        board_put(digits[--n]);
    board_put('.');
    for (; n < 6; n++, millionths /= 10u)
        digits[n] = (char)('0' + millionths % 10u);
    while (n > 0)
        board_put(digits[--n]);
}

static void put_log(void)
{
    const int32_t last = logged;
    put_text("t [s],r [rad],u [V],y [rad]\n");
    for (int32_t k = 0; k < last; k++) {
        const float row[] = {(float)(k * AXIS_SAMPLE_TIME), target(samples[k].turn), samples[k].u,
                             angle(samples[k].count)};
        for (int32_t i = 0; i < 4; i++) {
            put_number(row[i]);
            board_put(i < 3 ? ',' : '\n');
        }
    }
}

void motor_command(char command)
{
    static const char *const names[] = {"off", "tries", "slows", "stands", "runs", "fault: "};
    switch (command) {
    case 'b':
        if (mode != MOTOR_OFF && mode != MOTOR_FAULT)
            break;
        fault = "";
        waited = 0;
        begin = count;
        WRITTEN();
        mode = MOTOR_TRIES;
        break;
    case '+':
        turn = (int16_t)(turn + 1);
        break;
    case '-':
        turn = (int16_t)(turn - 1);
        break;
    case 'x':
        mode = MOTOR_OFF;
        break;
    case 'l':
        put_log();
        break;
    case '?':
        put_text(names[mode]);
        put_text(fault);
        put_text(", y = ");
        put_number(motor_angle());
        put_text(" rad\n");
        break;
    default:
        break;
    }
}

motor_mode motor_state(void) { return mode; }
const char *motor_fault(void) { return fault; }
float motor_angle(void) { return angle(position()); }
