/* A board over UDP, with the sockets of POSIX. */
#include "board_inside.h"

#include <errno.h>
#include <netdb.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static void answer(pea_board *b, const pea_board_frame *frame, const struct sockaddr_storage *to,
                   socklen_t length)
{
    size_t length_of = b->torn ? sizeof *frame / 2 : sizeof *frame;
    sendto(b->way, frame, length_of, MSG_DONTWAIT | MSG_NOSIGNAL, (const struct sockaddr *)to,
           length);
}

static void hello(pea_board *b, int stream, const struct sockaddr_storage *from, socklen_t length)
{
    pea_board_frame frame = {.magic = PEA_FRAME_BOARD, .kind = PEA_LIMITS, .period = b->setup.period};
    frame.is.limits.voltage_min = b->setup.voltage_min;
    frame.is.limits.voltage_max = b->setup.voltage_max;
    frame.is.limits.y_min = b->setup.y_min;
    frame.is.limits.y_max = b->setup.y_max;
    answer(b, &frame, from, length);
    frame.kind = PEA_IDENTITY;
    memcpy(frame.is.identity, b->identity, sizeof frame.is.identity);
    answer(b, &frame, from, length);
    int same = length == b->host_length && !memcmp(from, &b->host, length);
    if (stream) {
        b->host = *from;
        b->host_length = length;
        b->streaming = 1;
    } else if (same) {
        b->streaming = 0;
    }
}

static void serve(pea_board *b)
{
    pea_host_frame frame;
    struct sockaddr_storage from;
    for (;;) {
        socklen_t length = sizeof from;
        memset(&from, 0, sizeof from);
        ssize_t got = recvfrom(b->way, &frame, sizeof frame, MSG_DONTWAIT, (struct sockaddr *)&from,
                               &length);
        if (got < 0 && errno != ECONNREFUSED)
            return;
        if (got != sizeof frame || frame.magic != PEA_FRAME_HOST || pea_board_loses(b))
            continue;
        if (frame.kind == PEA_COMMAND || frame.kind == PEA_ASK || frame.kind == PEA_SAFE)
            pea_board_command(b, frame.u, frame.sequence);
        if (frame.kind == PEA_HELLO && !b->silent)
            hello(b, frame.u == 1.0, &from, length);
        if ((frame.kind == PEA_ASK || frame.kind == PEA_LOOK) && !b->silent && !b->behind) {
            pea_board_frame reply = b->newest;
            reply.is.sample.sequence = frame.sequence;
            answer(b, &reply, &from, length);
        }
    }
}

static void sleep_or_serve(pea_board *b, int64_t until)
{
    if (b->streaming) { /* commands count from the next sample on */
        pea_sleep_until(until);
        return;
    }
    int64_t left = until - pea_now();
    struct timespec wait = {left / 1000000000, left % 1000000000};
    struct pollfd way = {b->way, POLLIN, 0};
    if (left > 0 && ppoll(&way, 1, &wait, NULL) > 0)
        serve(b);
}

static void give(pea_board *b, const pea_board_frame *frame)
{
    if (b->streaming)
        answer(b, frame, &b->host, b->host_length);
}

static void end(pea_board *b) { close(b->way); }

static int begin(pea_board *b, char *error, size_t size)
{
    char host[256];
    const char *place = b->setup.address + 6, *port = strrchr(place, ':');
    struct addrinfo hints = {.ai_socktype = SOCK_DGRAM, .ai_flags = AI_PASSIVE}, *found;
    if (!port || port == place) {
        snprintf(error, size, "%s: write udp://HOST:PORT", b->setup.address);
        return 0;
    }
    snprintf(host, sizeof host, "%.*s", (int)(port - place), place);
    if (getaddrinfo(host, port + 1, &hints, &found)) {
        snprintf(error, size, "%s: no such address of this machine", b->setup.address);
        return 0;
    }
    b->way = socket(found->ai_family, found->ai_socktype | SOCK_CLOEXEC, 0);
    int bound = b->way >= 0 && !bind(b->way, found->ai_addr, found->ai_addrlen);
    freeaddrinfo(found);
    if (!bound) {
        snprintf(error, size, "%s: %s", b->setup.address, strerror(errno));
        return 0;
    }
    struct sockaddr_storage own;
    socklen_t length = sizeof own;
    getsockname(b->way, (struct sockaddr *)&own, &length);
    b->port = ntohs(own.ss_family == AF_INET6 ? ((struct sockaddr_in6 *)&own)->sin6_port
                                              : ((struct sockaddr_in *)&own)->sin_port);
    return 1;
}

const pea_transport pea_over_udp = {begin, serve, sleep_or_serve, give, end};
