/* A Modbus RTU master on libmodbus for the bench: reads eleven process data registers of each drive in turn, with a pause
 * after each reply. Arguments: port, baud, drives, run time (us), pause (ns), part of the pause that watches the clock
 * instead of sleeping (ns), reply timeout (us). Prints its rate. */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <time.h>

static long long now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static void wait_until(long long at, long long spin) {
    long long asleep = at - spin;
    struct timespec t = {asleep / 1000000000LL, asleep % 1000000000LL};
    if (now_ns() < asleep)
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
    while (now_ns() < at) {
    }
}

int main(int argc, char **argv) {
    if (argc != 8) {
        fprintf(stderr, "usage: %s PORT BAUD DRIVES TIME_US PAUSE_NS SPIN_NS TIMEOUT_US\n", argv[0]);
        return 2;
    }
    int drives = atoi(argv[3]);
    long long time = atoll(argv[4]) * 1000, pause = atoll(argv[5]), spin = atoll(argv[6]);
    /* As the threads of the other masters have it; where it is refused, theirs is refused too. */
    prctl(PR_SET_TIMERSLACK, 1L);
    (void)setpriority(PRIO_PROCESS, 0, -10);
    modbus_t *bus = modbus_new_rtu(argv[1], atoi(argv[2]), 'N', 8, 1);
    if (bus == NULL || modbus_connect(bus) == -1) {
        fprintf(stderr, "%s: %s\n", argv[1], modbus_strerror(errno));
        return 1;
    }
    /* Counted from the moment the request was handed over, so the time on the wire is part of it. */
    modbus_set_response_timeout(bus, 0, (uint32_t)atoll(argv[7]) + 270000000U / (uint32_t)atoi(argv[2]));
    long long start = now_ns(), replies = 0, failures = 0;
    for (int drive = 1; now_ns() - start < time; drive = drive % drives + 1) {
        uint16_t words[11];
        modbus_set_slave(bus, drive);
        if (modbus_read_registers(bus, 2100, 11, words) == 11)
            replies++;
        else
            failures++;
        wait_until(now_ns() + pause, spin);
    }
    printf("%.2f replies/s, %lld failures\n", replies * 1e9 / (double)(now_ns() - start), failures);
    modbus_close(bus);
    modbus_free(bus);
    return 0;
}
