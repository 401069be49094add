/* Driver of memory-mapped registers (pea_registers.h): a card's BAR, a Zynq, /dev/uio0.
 *
 * Address: a file that can be mapped, such as /sys/bus/pci/devices/0000:03:00.0/resource0,
 * /dev/uio0, or /dev/shm/NAME where another process stands for the card. With PEA_CLOCK an
 * exchange takes less than a microsecond. With PEA_DEVICE it sleeps until shortly before the
 * card's next sample and spins for the rest.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#include "pea_driver.h"
#include "pea_registers.h"

#define SPIN_NS 15000

struct pea_device {
    pea_options options;
    pea_registers *card;
    uint64_t counter;
    int64_t arrived;
};

static int64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void sleep_until(int64_t t)
{
    struct timespec due = {t / 1000000000, t % 1000000000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
}

static void fence(void) { __atomic_thread_fence(__ATOMIC_SEQ_CST); }

/* A whole sample, the newest; 0 where the card writes just now. */
static int look(const pea_registers *card, pea_sample *sample)
{
    uint64_t counter = card->counter;
    fence();
    sample->y = card->y;
    sample->u_applied = card->u_applied;
    sample->counter = counter;
    fence();
    return card->begun == counter;
}

static void command(pea_registers *card, double u)
{
    card->u = u;
    fence();
    card->commands = card->commands + 1;
}

static pea_device *refuse(pea_device *d, char *error, size_t size, const char *what)
{
    snprintf(error, size, "%s", what);
    free(d);
    return NULL;
}

uint32_t pea_driver_version(void) { return PEA_DRIVER_VERSION; }

pea_device *pea_driver_open(const pea_options *options, char *error, size_t size)
{
    pea_device *d = calloc(1, sizeof *d);
    if (!d)
        return refuse(d, error, size, "no memory");
    d->options = *options;
    int file = open(options->address, O_RDWR | O_SYNC | O_CLOEXEC);
    if (file < 0)
        return refuse(d, error, size, strerror(errno));
    void *mapped = mmap(NULL, sizeof(pea_registers), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    int why = errno;
    off_t length = lseek(file, 0, SEEK_END);
    close(file);
    if (mapped == MAP_FAILED)
        return refuse(d, error, size, strerror(why));
    d->card = mapped;
    /* a file that is shorter would end the process at the first look */
    if ((length > 0 && length < (off_t)sizeof(pea_registers)) || d->card->magic != PEA_REGISTERS_MAGIC) {
        munmap(mapped, sizeof(pea_registers));
        return refuse(d, error, size, "these are not the registers of pea_registers.h");
    }
    if (options->pace == PEA_DEVICE && d->card->period != options->period_ns) {
        char what[128];
        snprintf(what, sizeof what, "the card samples each %lld ns, the loop each %lld ns",
                 (long long)d->card->period, (long long)options->period_ns);
        munmap(mapped, sizeof(pea_registers));
        return refuse(d, error, size, what);
    }
    d->counter = d->card->counter;
    d->arrived = now();
    return d;
}

int pea_driver_identify(pea_device *d, char *text, size_t size)
{
    snprintf(text, size, "%.16s", d->card->identity);
    return PEA_OK;
}

int pea_driver_limits(pea_device *d, pea_limits *limits)
{
    limits->voltage_min = d->card->voltage_min;
    limits->voltage_max = d->card->voltage_max;
    limits->y_min = d->card->y_min;
    limits->y_max = d->card->y_max;
    return PEA_OK;
}

int pea_driver_exchange(pea_device *d, double u, uint32_t flags, pea_sample *sample)
{
    if (!(flags & PEA_HOLD))
        command(d->card, u);
    int device = d->options.pace == PEA_DEVICE;
    int64_t t = now(), end = t + d->options.timeout_ns;
    if (flags & PEA_FRESH) {
        d->counter = d->card->counter;
        d->arrived = t; /* a pause of the loop is no silence of the card */
    }
    int64_t due = device ? d->arrived + d->card->period - SPIN_NS : 0;
    while (!look(d->card, sample) || (device && sample->counter == d->counter)) {
        if (t > end)
            return PEA_TIMEOUT;
        if (t < due)
            sleep_until(due);
        else if (t > due + 8 * SPIN_NS && device)
            sleep_until(t + 50000);
        t = now();
    }
    if (sample->counter != d->counter)
        d->arrived = t;
    else if (t - d->arrived > d->options.timeout_ns)
        return PEA_TIMEOUT; /* the card stands still */
    d->counter = sample->counter;
    return PEA_OK;
}

int pea_driver_safe(pea_device *d, double u)
{
    command(d->card, u);
    return PEA_OK;
}

void pea_driver_close(pea_device *d)
{
    munmap(d->card, sizeof(pea_registers));
    free(d);
}
