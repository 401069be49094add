/* A card in memory: a file stands for its registers. */
#include "board_inside.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "pea_registers.h"

static void fence(void) { __atomic_thread_fence(__ATOMIC_SEQ_CST); }

static void serve(pea_board *b)
{
    pea_registers *card = b->card;
    uint64_t commands = card->commands;
    if (commands == b->taken)
        return;
    fence();
    pea_board_command(b, card->u, commands);
    b->taken = commands;
}

static void sleep_to(pea_board *b, int64_t until)
{
    (void)b;
    pea_sleep_until(until);
}

static void give(pea_board *b, const pea_board_frame *frame)
{
    pea_registers *card = b->card;
    card->begun = frame->counter;
    if (b->torn)
        return;
    fence();
    card->y = frame->is.sample.y;
    card->u_applied = frame->is.sample.u_applied;
    fence();
    card->counter = frame->counter;
}

static void end(pea_board *b)
{
    pea_registers *card = b->card;
    card->magic = 0;
    munmap(b->card, sizeof(pea_registers));
    unlink(b->path);
}

static int begin(pea_board *b, char *error, size_t size)
{
    snprintf(b->path, sizeof b->path, "%s", b->setup.address);
    int file = open(b->path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0600);
    if (file < 0 || ftruncate(file, sizeof(pea_registers))) {
        snprintf(error, size, "%s: %s", b->path, strerror(errno));
        return 0;
    }
    b->card = mmap(NULL, sizeof(pea_registers), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    if (b->card == MAP_FAILED) {
        snprintf(error, size, "%s: %s", b->path, strerror(errno));
        return 0;
    }
    pea_registers *card = b->card;
    card->period = b->setup.period;
    card->voltage_min = b->setup.voltage_min;
    card->voltage_max = b->setup.voltage_max;
    card->y_min = b->setup.y_min;
    card->y_max = b->setup.y_max;
    memcpy(card->identity, b->identity, sizeof card->identity);
    fence();
    card->magic = PEA_REGISTERS_MAGIC;
    return 1;
}

const pea_transport pea_over_registers = {begin, serve, sleep_to, give, end};
