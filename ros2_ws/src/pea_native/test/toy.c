/* A driver without a device, which behaves as its address says: good, or one way to be bad. */
#include <fcntl.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "pea_driver.h"

#ifndef TOY_VERSION
#define TOY_VERSION PEA_DRIVER_VERSION
#endif
#define LOG 65536

struct pea_device {
    char way[64];
    double u;
    uint64_t counter;
    unsigned seed;
};

double toy_given[LOG];
int64_t toy_times[LOG];
long toy_count;
static struct pea_device only;

/* Note a voltage that was given (V), and when (ns), in the file TOY_LOG: whoever gave it. */
static void note(double u)
{
    static int file = -1;
    struct timespec t;
    struct {
        double t, u;
    } line;
    if (file < 0 && getenv("TOY_LOG"))
        file = open(getenv("TOY_LOG"), O_WRONLY | O_APPEND | O_CLOEXEC);
    clock_gettime(CLOCK_MONOTONIC, &t);
    line.t = (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
    line.u = u;
    if (file >= 0 && write(file, &line, sizeof line) < 0)
        abort();
}

uint32_t pea_driver_version(void) { return TOY_VERSION; }

static int is(const char *way) { return !strcmp(only.way, way); }

pea_device *pea_driver_open(const pea_options *options, char *error, size_t size)
{
    memset(&only, 0, sizeof only);
    snprintf(only.way, sizeof only.way, "%s", options->address);
    sscanf(options->address, "random=%u", &only.seed);
    if (is("closed")) {
        snprintf(error, size, "nobody\nis at home");
        return NULL;
    }
    return &only;
}

int pea_driver_identify(pea_device *d, char *text, size_t size)
{
    (void)d;
    snprintf(text, size, "toy");
    return PEA_OK;
}

int pea_driver_limits(pea_device *d, pea_limits *limits)
{
    (void)d;
    *limits = (pea_limits){-30.0, 130.0, -5e-6, 20e-6};
    if (is("limits"))
        limits->voltage_max = -40.0;
    return PEA_OK;
}

#ifndef TOY_WITHOUT_EXCHANGE
int pea_driver_exchange(pea_device *d, double u, uint32_t flags, pea_sample *sample)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    sample->u_applied = d->u;
    sample->counter = ++d->counter;
    sample->y = 0.142e-6 * d->u + 1e-12 * (double)(d->counter % 7);
    if (!(flags & PEA_HOLD)) {
        if (toy_count < LOG) {
            toy_times[toy_count] = t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
            toy_given[toy_count] = u;
        }
        toy_count++;
        d->u = u;
        note(u);
    } else if (is("moves")) {
        d->u += 0.1;
    }
    if (is("crash") && d->counter > 500)
        abort();
    if (is("hang"))
        for (;;)
            nanosleep(&(struct timespec){1, 0}, NULL);
    if (is("nan") && d->counter > 500)
        sample->y = NAN;
    if (is("backwards"))
        sample->counter = 1000 - d->counter;
    if (is("wide"))
        sample->u_applied = 1e6;
    if (is("crash later") && toy_count > 200)
        raise(SIGSEGV);
    if (is("killed later") && toy_count > 200)
        raise(SIGKILL);
    if (is("hang later") && toy_count > 200)
        for (;;)
            nanosleep(&(struct timespec){1, 0}, NULL);
    if (is("silent later") && toy_count > 200) {
        nanosleep(&(struct timespec){0, 200000000}, NULL);
        return PEA_TIMEOUT;
    }
    if (is("fails later") && toy_count > 200)
        return PEA_TIMEOUT;
    if (is("nan later") && toy_count > 200)
        sample->y = NAN;
    if (is("wide later") && toy_count > 200)
        sample->u_applied = NAN;
    if (d->seed && toy_count > 20) { /* noise of any size; now and then a failure */
        double r = rand_r(&d->seed) / (double)RAND_MAX, q = rand_r(&d->seed) / (double)RAND_MAX;
        sample->y = (r - 0.5) * pow(10.0, 12.0 * q - 10.0);
        sample->u_applied = -30.0 + 160.0 * r;
        sample->counter += (uint64_t)(q * 5);
        if (q < 0.0005)
            return (int)(1 + r * 80);
        if (q > 0.9995)
            sample->y = r < 0.5 ? INFINITY : NAN;
    }
    return PEA_OK;
}
#endif

int pea_driver_safe(pea_device *d, double u)
{
    d->u = u;
    note(u);
    return PEA_OK;
}

void pea_driver_close(pea_device *d) { (void)d; }
