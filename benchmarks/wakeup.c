/* Limit of a machine's timing: only sleep until each absolute deadline, with SCHED_FIFO, locked
 * memory and no deep sleep states.
 * Arguments: period [ns], number of deadlines. Prints the lateness of each wake-up [ns], one per line. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

static long long now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

int main(int count, char **arguments)
{
    if (count != 3)
        return 2;
    const long long period = atoll(arguments[1]), deadlines = atoll(arguments[2]);
    long long *late = malloc(deadlines * sizeof *late);
    memset(late, 0, deadlines * sizeof *late);
    const struct sched_param priority = {.sched_priority = 50};
    const int latency = 0, file = open("/dev/cpu_dma_latency", O_WRONLY);
    if (sched_setscheduler(0, SCHED_FIFO, &priority) || mlockall(MCL_CURRENT | MCL_FUTURE) ||
        write(file, &latency, sizeof latency) < 0)
        fprintf(stderr, "wakeup: some real-time settings are not permitted\n");
    const long long begin = now() + period;
    for (long long k = 0; k < deadlines; k++) {
        const long long deadline = begin + k * period;
        const struct timespec until = {deadline / 1000000000, deadline % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL))
            ;
        late[k] = now() - deadline;
    }
    for (long long k = 0; k < deadlines; k++)
        printf("%lld\n", late[k]);
    return 0;
}
