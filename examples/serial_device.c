/* The device's side of quell's serial line, for a microcontroller.
 *
 * Frames, packets and sessions are those of wire/frames.py, wire/cobs.py and rig/kernel.py in
 * src/quell/realtime. Write the four board_ functions, call quell_byte() for each received byte and
 * quell_tick() every DT from a timer. If quell_tick() can interrupt quell_byte(), define QUELL_LOCK()
 * and QUELL_UNLOCK() as interrupts off and on: a tick must not see half of a command. The processor
 * must be little-endian, with 64-bit double (not AVR).
 *
 * If the controller runs on the device, too, the commands are references and board_apply() computes u;
 * it sends what shall be recorded with quell_telemetry(). See target/serial_target.c.
 *
 * With -DQUELL_HOST this is a program that simulates y' = u on a pseudoterminal and prints the name
 * of its other end.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef DT
#define DT 0.001     /* sample time [s] */
#endif
#ifndef U_MAX
#define U_MAX 10.0   /* larger commands are limited to it [u-unit] */
#endif
#ifndef WATCHDOG
#define WATCHDOG 20  /* ticks without a fresh command until u is zero; reset by a new session */
#endif
#ifndef PATIENCE
#define PATIENCE 60000 /* ticks that a session may wait for its first command */
#endif
#ifndef MOST_AGE
#define MOST_AGE 20  /* a command is stale if the answered measurement is older [ticks] */
#endif
#ifndef QUELL_LOCK
#define QUELL_LOCK()
#define QUELL_UNLOCK()
#endif

double board_measure(void);                     /* return y [y-unit] */
void board_apply(double u);                     /* apply u until the next call [u-unit] */
void board_send(const uint8_t *data, int size); /* append to the UART's queue; must not wait */
int64_t board_time(void);                       /* return the time of any monotonic clock [ns] */

enum { MEASUREMENT = 1, COMMAND, HELLO, WELCOME, GOODBYE, TELEMETRY };
enum { TRIPPED_FLAG = 1, BUSY_FLAG = 2, OTHER_DT_FLAG = 4 };

typedef struct {
    char magic[2];
    uint8_t version, kind;
    uint32_t session, number, answers;
    int64_t time;
    double value;
    uint32_t state, crc;
} Frame; /* 40 bytes, without gaps */

static enum { IDLE, WAITING, LIVE, TRIPPED } mode = IDLE;
static uint32_t session, sent, heard;
static double newest, applied;
static int fresh, silent;
static uint32_t answered; /* number of the measurement that the last command answers */

static uint32_t crc32(const void *data, int size)
{
    const uint8_t *byte = data;
    uint32_t crc = 0xFFFFFFFFu;
    while (size-- > 0) {
        crc ^= *byte++;
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

static void send_frame(uint8_t kind, uint32_t to, uint32_t number, double value, uint32_t state)
{
    Frame frame = {{'Q', 'L'}, 1, kind, to, number, number ? heard : 0, board_time(), value, state, 0};
    uint8_t packet[sizeof frame + 2], *code = packet, *out = packet + 1;
    const uint8_t *data = (const uint8_t *)&frame;
    frame.crc = crc32(&frame, sizeof frame - 4);
    for (unsigned i = 0; i < sizeof frame; i++) {
        if (data[i]) {
            *out++ = data[i];
        } else {
            *code = (uint8_t)(out - code);
            code = out++;
        }
    }
    *code = (uint8_t)(out - code);
    *out++ = 0;
    board_send(packet, (int)(out - packet));
}

static void greet(const Frame *hello)
{
    uint32_t refusal = 0;
    int known = hello->session == session;
    if (hello->session == 0 || (known && (mode == IDLE || mode == TRIPPED)))
        return; /* a finished session does not come back */
    if (!known) {
        if (!(fabs(hello->value - DT) <= 1e-9 * DT)) {
            refusal = OTHER_DT_FLAG;
        } else if (mode == WAITING || mode == LIVE) {
            refusal = BUSY_FLAG;
        } else {
            session = hello->session;
            sent = heard = answered = 0;
            silent = fresh = 0;
            applied = 0.0;
            mode = WAITING;
        }
    }
    send_frame(WELCOME, hello->session, 0, DT, refusal);
}

static void take(const Frame *frame)
{
    if (frame->kind == HELLO) {
        greet(frame);
    } else if (mode != IDLE && frame->session == session) {
        if (frame->kind == GOODBYE) {
            mode = IDLE;
        } else if (frame->kind == COMMAND) {
            int32_t ahead = (int32_t)(frame->number - heard), age = (int32_t)(sent - frame->answers);
            if (ahead <= 0 || age < 0 || age > MOST_AGE)
                return;
            heard = frame->number;
            answered = frame->answers;
            if (isfinite(frame->value)) {
                newest = frame->value;
                fresh = 1;
            }
        }
    }
}

void quell_byte(uint8_t byte)
{
    static uint8_t packet[sizeof(Frame) + 2];
    static unsigned size;
    if (byte != 0) {
        if (size < sizeof packet)
            packet[size] = byte;
        size += size < sizeof packet;
        return;
    }
    uint8_t data[sizeof packet];
    unsigned in = 0, out = 0, end = size;
    size = 0;
    if (end >= sizeof packet)
        return;
    while (in < end) {
        unsigned code = packet[in];
        if (in + code > end)
            return;
        memcpy(data + out, packet + in + 1, code - 1);
        out += code - 1;
        in += code;
        if (in < end)
            data[out++] = 0;
    }
    if (out == sizeof(Frame)) {
        Frame frame;
        memcpy(&frame, data, sizeof frame);
        if (memcmp(frame.magic, "QL\1", 3) || frame.crc != crc32(&frame, sizeof frame - 4))
            return;
        QUELL_LOCK();
        take(&frame);
        QUELL_UNLOCK();
    }
}

void quell_tick(void)
{
    if (fresh && mode == WAITING)
        mode = LIVE;
    silent = fresh ? 0 : silent + 1;
    if (fresh)
        applied = fmin(fmax(newest, -U_MAX), U_MAX);
    fresh = 0;
    if (mode == LIVE && silent >= WATCHDOG)
        mode = TRIPPED;
    else if (mode == WAITING && silent >= PATIENCE)
        mode = IDLE;
    if (mode != LIVE)
        applied = 0.0;
    double y = board_measure();
    if (mode != IDLE)
        send_frame(MEASUREMENT, session, ++sent, y, mode == TRIPPED ? TRIPPED_FLAG : 0);
    board_apply(applied);
}

/* Send a channel of the telemetry of this tick, from board_apply(); the loop knows its name. */
void quell_telemetry(uint32_t channel, double value)
{
    if (mode != IDLE)
        send_frame(TELEMETRY, session, sent, value, channel);
}

/* Return whether a command answers the last measurement; a simulated plant can wait for it. */
int quell_answered(void) { return answered == sent; }

#ifdef QUELL_HOST
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static int line, packets;
static double y;

double board_measure(void) { return y; }
void board_apply(double u) { y += DT * u; }
void board_send(const uint8_t *data, int size)
{
    if (write(line, data, (size_t)size) != size)
        fputs("a frame was cut short\n", stderr);
}
int64_t board_time(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

/* For tests: each t on the standard input runs a tick, each c waits for a packet. */
int main(void)
{
    uint8_t byte;
    int c;
    line = posix_openpt(O_RDWR | O_NOCTTY);
    if (line < 0 || grantpt(line) || unlockpt(line))
        return 1;
    int other = open(ptsname(line), O_RDWR | O_NOCTTY); /* kept open, so that the line does not hang up */
    printf("serial://%s\n", ptsname(line));
    fflush(stdout);
    while ((c = getchar()) != EOF) {
        if (c == 't')
            quell_tick();
        for (packets = 0; c == 'c' && packets == 0;) {
            static int within;
            if (read(line, &byte, 1) != 1)
                return 1;
            quell_byte(byte);
            packets += within && byte == 0;
            within = byte != 0;
        }
        if (c == 't' || c == 'c') {
            printf("%d %.17g %.17g\n", mode, y, applied);
            fflush(stdout);
        }
    }
    close(other);
    return 0;
}
#endif
