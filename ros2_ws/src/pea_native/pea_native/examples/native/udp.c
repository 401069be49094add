/* Driver of a board that talks frames over UDP (examples/board): Teensy, STM32, Zynq, FPGA.
 *
 * Address: udp://HOST:PORT. With PEA_DEVICE the board streams and sets the pace; an exchange sends
 * the command and waits for the next sample. With PEA_CLOCK each exchange is a request and its
 * answer. A wait sleeps until shortly before the answer is due and spins for the rest: a thread
 * that is woken by the network is late by some 10 us, one that always spins is stopped by the
 * system.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "pea_driver.h"
#include "pea_frame.h"

#define SPIN_NS 15000
#define TRIES_NS 20000000

struct pea_device {
    int way;
    pea_options options;
    pea_limits limits;
    char identity[64];
    uint64_t sequence, counter;
    int64_t period, arrived;
    int begun;
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

static int say(pea_device *d, uint32_t kind, double u)
{
    pea_host_frame frame = {PEA_FRAME_HOST, kind, ++d->sequence, u, 0};
    ssize_t sent;
    do
        sent = send(d->way, &frame, sizeof frame, MSG_DONTWAIT | MSG_NOSIGNAL);
    while (sent < 0 && errno == EINTR);
    /* nobody listens on that port: the next frame may find a board that has started */
    return sent == sizeof frame ? PEA_OK : PEA_LOST;
}

/* The next frame of a kind that comes by `end`; sleeps until `sleep` at most. */
static int hear(pea_device *d, uint32_t kind, int64_t sleep, int64_t end, pea_board_frame *frame)
{
    for (;;) {
        ssize_t got = recv(d->way, frame, sizeof *frame, MSG_DONTWAIT);
        if (got == sizeof *frame && frame->magic == PEA_FRAME_BOARD && frame->kind == kind)
            return PEA_OK;
        if (got < 0 && errno == ECONNREFUSED)
            return PEA_LOST;
        if (got < 0 && errno != EAGAIN && errno != EINTR)
            return PEA_LOST;
        int64_t t = now();
        if (t > end)
            return PEA_TIMEOUT;
        if (got < 0 && t < sleep)
            sleep_until(sleep < end ? sleep : end);
        else if (got < 0 && t > sleep + 8 * SPIN_NS)
            sleep_until(t + 50000); /* it is late: leave the core to others */
    }
}

static pea_device *refuse(pea_device *d, char *error, size_t size, const char *what)
{
    snprintf(error, size, "%s", what);
    if (d && d->way >= 0)
        close(d->way);
    free(d);
    return NULL;
}

uint32_t pea_driver_version(void) { return PEA_DRIVER_VERSION; }

pea_device *pea_driver_open(const pea_options *options, char *error, size_t size)
{
    char host[256], text[320], why[384];
    const char *port;
    struct addrinfo hints = {.ai_socktype = SOCK_DGRAM}, *found = NULL;
    pea_device *d = calloc(1, sizeof *d);
    if (!d)
        return refuse(d, error, size, "no memory");
    d->way = -1;
    d->options = *options;
    snprintf(text, sizeof text, "%s", options->address);
    if (strncmp(text, "udp://", 6) || !(port = strrchr(text, ':')) || port - text <= 6 || !port[1])
        return refuse(d, error, size, "write udp://HOST:PORT");
    snprintf(host, sizeof host, "%.*s", (int)(port - text - 6), text + 6);
    if (host[0] == '[' && host[strlen(host) - 1] == ']') {
        memmove(host, host + 1, strlen(host));
        host[strlen(host) - 1] = 0;
    }
    if (getaddrinfo(host, port + 1, &hints, &found)) {
        snprintf(why, sizeof why, "there is no host %s with a port %s", host, port + 1);
        return refuse(d, error, size, why);
    }
    d->way = socket(found->ai_family, found->ai_socktype | SOCK_CLOEXEC, 0);
    int connected = d->way >= 0 && !connect(d->way, found->ai_addr, found->ai_addrlen);
    freeaddrinfo(found);
    if (!connected)
        return refuse(d, error, size, strerror(errno));
    if (options->role == PEA_RESCUE)
        return d;
    int stream = options->pace == PEA_DEVICE, heard = 0;
    pea_board_frame frame;
    for (int64_t end = now() + options->connect_ns; !heard && now() < end;) {
        say(d, PEA_HELLO, stream);
        int64_t until = now() + TRIES_NS;
        if (hear(d, PEA_LIMITS, 0, until, &frame) != PEA_OK) {
            sleep_until(until);
            continue;
        }
        d->period = frame.period;
        memcpy(&d->limits, &frame.is.limits, sizeof d->limits);
        heard = hear(d, PEA_IDENTITY, 0, until, &frame) == PEA_OK;
    }
    if (!heard)
        return refuse(d, error, size, "no board answers");
    snprintf(d->identity, sizeof d->identity, "%.32s", frame.is.identity);
    if (stream && d->period != options->period_ns) {
        snprintf(why, sizeof why, "the board samples each %lld ns, the loop each %lld ns",
                 (long long)d->period, (long long)options->period_ns);
        return refuse(d, error, size, why);
    }
    return d;
}

int pea_driver_identify(pea_device *d, char *text, size_t size)
{
    snprintf(text, size, "%s", d->identity);
    return PEA_OK;
}

int pea_driver_limits(pea_device *d, pea_limits *limits)
{
    *limits = d->limits;
    return PEA_OK;
}

int pea_driver_exchange(pea_device *d, double u, uint32_t flags, pea_sample *sample)
{
    int hold = flags & PEA_HOLD, stream = d->options.pace == PEA_DEVICE;
    int64_t end = now() + d->options.timeout_ns;
    pea_board_frame frame;
    int code = PEA_OK;
    if (flags & PEA_FRESH)
        while (recv(d->way, &frame, sizeof frame, MSG_DONTWAIT) >= 0)
            if (now() > end)
                return PEA_TIMEOUT; /* it talks without end */
    if (!stream)
        code = say(d, hold ? PEA_LOOK : PEA_ASK, u);
    else if (!hold)
        code = say(d, PEA_COMMAND, u);
    if (code)
        return code;
    for (;;) {
        int64_t due = stream ? d->arrived + d->period - SPIN_NS : 0;
        code = hear(d, PEA_SAMPLE, due, end, &frame);
        if (code)
            return code;
        if (stream ? !d->begun || frame.counter > d->counter : frame.is.sample.sequence >= d->sequence)
            break;
        /* an answer to an earlier request, or a frame that came twice; whatever comes, an exchange
         * has one deadline */
        if (now() > end)
            return PEA_TIMEOUT;
    }
    d->arrived = now();
    d->begun = 1;
    d->counter = frame.counter;
    sample->y = frame.is.sample.y;
    sample->u_applied = frame.is.sample.u_applied;
    sample->counter = frame.counter;
    return PEA_OK;
}

int pea_driver_safe(pea_device *d, double u) { return say(d, PEA_SAFE, u); }

void pea_driver_close(pea_device *d)
{
    if (d->options.role == PEA_DRIVE)
        say(d, PEA_HELLO, 0); /* stream no more */
    close(d->way);
    free(d);
}
