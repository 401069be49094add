/* The board's side: samples a stage each period, takes commands, gives samples.
 *
 * An application opens a board, then goes round: `pea_board_wait` until the next sample is due,
 * which returns the newest command; read the sensor, write the output, `pea_board_give`. Firmware
 * keeps this header and pea_frame.h and puts its network stack in place of board_udp.c.
 */
#ifndef PEA_BOARD_H
#define PEA_BOARD_H

#include <stddef.h>
#include <stdint.h>

typedef struct pea_board pea_board;

typedef struct {
    const char *address;  /* udp://HOST:PORT to listen on, or a file for the registers */
    const char *identity; /* one word */
    int64_t period;       /* ns */
    double voltage_min, voltage_max, y_min, y_max; /* V, m */
} pea_board_setup;

/* The board, or NULL and one line of text why not in error[size]. */
pea_board *pea_board_open(const pea_board_setup *setup, char *error, size_t size);

/* Port that a UDP board listens on, 0 of another one. */
int pea_board_port(const pea_board *board);

/* Wait for `due` (ns, CLOCK_MONOTONIC), serving the host; the newest command (V), held within the
 * board's range. */
double pea_board_wait(pea_board *board, int64_t due);

/* Commands taken so far. */
int64_t pea_board_commands(const pea_board *board);

/* Give sample `counter`, now, or `delay` (ns) later; -1: never. */
void pea_board_give(pea_board *board, uint64_t counter, double y, double u_applied, int64_t delay);

/* Play faults, for rehearsals: of so many frames of 1000 none arrives, either way; each sample is
 * repeated until the next one; each breaks off in the middle. */
void pea_board_spoil(pea_board *board, int lost, int babbles, int torn);

void pea_board_close(pea_board *board);

#endif
