/* Shared by board.c and its two transports; no part of what an application sees. */
#ifndef PEA_BOARD_INSIDE_H
#define PEA_BOARD_INSIDE_H

#include <netinet/in.h>

#include "pea_board.h"
#include "pea_frame.h"

#define PEA_SPIN 15000 /* the last ns before a deadline are not slept */
#define PEA_LATE 16384 /* samples that may be under way */

typedef struct {
    int (*open)(pea_board *, char *error, size_t size);
    void (*serve)(pea_board *);                /* take what has come */
    void (*sleep)(pea_board *, int64_t until); /* serve the host until then, or sleep */
    void (*give)(pea_board *, const pea_board_frame *); /* half of it where `torn` */
    void (*close)(pea_board *);
} pea_transport;

extern const pea_transport pea_over_udp, pea_over_registers;

struct pea_board {
    pea_board_setup setup;
    char identity[32];
    const pea_transport *transport;
    double u;
    uint64_t sequence;
    int64_t commands;
    pea_board_frame newest;
    int silent, behind;
    int lost, babbles, torn; /* faults, see pea_board_spoil */
    unsigned seed;
    struct {
        int64_t t;
        pea_board_frame frame;
    } late[PEA_LATE];
    uint64_t first, last;
    /* over UDP */
    int way, port, streaming;
    struct sockaddr_storage host;
    socklen_t host_length;
    /* over registers */
    void *card;
    uint64_t taken;
    int ours; /* the file was made here */
    char path[256];
};

int64_t pea_now(void);
void pea_sleep_until(int64_t t);
int pea_board_loses(pea_board *); /* whether a frame is lost on its way */
void pea_board_command(pea_board *, double u, uint64_t sequence);

#endif
