/* What boards of either kind have in common: time, the newest command, samples that are late. */
#include "board_inside.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

int64_t pea_now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

void pea_sleep_until(int64_t t)
{
    struct timespec due = {t / 1000000000, t % 1000000000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
}

int pea_board_loses(pea_board *b)
{
    b->seed = b->seed * 1103515245u + 12345u;
    return (int)((b->seed >> 16) % 1000u) < b->lost;
}

void pea_board_spoil(pea_board *b, int lost, int babbles, int torn)
{
    b->lost = lost;
    b->babbles = babbles;
    b->torn = torn;
}

void pea_board_command(pea_board *b, double u, uint64_t sequence)
{
    if (!isfinite(u))
        return;
    b->u = u < b->setup.voltage_min ? b->setup.voltage_min : u;
    b->u = b->u > b->setup.voltage_max ? b->setup.voltage_max : b->u;
    b->sequence = sequence;
    b->commands++;
}

pea_board *pea_board_open(const pea_board_setup *setup, char *error, size_t size)
{
    pea_board *b = calloc(1, sizeof *b);
    if (!b) {
        snprintf(error, size, "no memory");
        return NULL;
    }
    b->setup = *setup;
    snprintf(b->identity, sizeof b->identity, "%s", setup->identity);
    b->way = -1;
    b->transport = strncmp(setup->address, "udp://", 6) ? &pea_over_registers : &pea_over_udp;
    if (b->transport->open(b, error, size))
        return b;
    free(b);
    return NULL;
}

int pea_board_port(const pea_board *b) { return b->port; }

int64_t pea_board_commands(const pea_board *b) { return b->commands; }

static void send_late(pea_board *b, int64_t t)
{
    while (b->first != b->last && b->late[b->first % PEA_LATE].t <= t)
        b->transport->give(b, &b->late[b->first++ % PEA_LATE].frame);
}

double pea_board_wait(pea_board *b, int64_t due)
{
    int64_t t = pea_now();
    b->transport->serve(b);
    while (t < due) {
        if (b->babbles && b->newest.counter)
            b->transport->give(b, &b->newest);
        if (due - t > PEA_SPIN && !b->babbles)
            b->transport->sleep(b, due - PEA_SPIN);
        else
            b->transport->serve(b);
        t = pea_now();
    }
    b->transport->serve(b);
    send_late(b, t);
    return b->u;
}

void pea_board_give(pea_board *b, uint64_t counter, double y, double u_applied, int64_t delay)
{
    pea_board_frame *frame = &b->newest;
    frame->magic = PEA_FRAME_BOARD;
    frame->kind = PEA_SAMPLE;
    frame->counter = counter;
    frame->is.sample.y = y;
    frame->is.sample.u_applied = u_applied;
    frame->is.sample.sequence = b->sequence;
    frame->is.sample.stamp = pea_now();
    frame->period = b->setup.period;
    b->silent = delay < 0;
    if (delay > 0 && b->last - b->first < PEA_LATE) {
        b->late[b->last % PEA_LATE].t = frame->is.sample.stamp + delay;
        b->late[b->last++ % PEA_LATE].frame = *frame;
    } else if (delay == 0 && !pea_board_loses(b)) {
        b->transport->give(b, frame);
    }
    b->behind = delay > 0;
}

void pea_board_close(pea_board *b)
{
    b->transport->close(b);
    free(b);
}
