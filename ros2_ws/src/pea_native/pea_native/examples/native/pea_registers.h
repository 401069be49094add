/* Registers that a card and a host share: a card's BAR, block RAM of a Zynq, /dev/uio0, or memory.
 *
 * Each side writes what is its own. A sample is whole when `begun` and `counter` are the same:
 * the card writes `begun`, then the sample, then `counter`. A command is whole as it is one store
 * of eight bytes; `commands` is written after it.
 */
#ifndef PEA_REGISTERS_H
#define PEA_REGISTERS_H

#include <stdint.h>

#define PEA_REGISTERS_MAGIC UINT64_C(0x3152474552414550) /* "PEAREGR1" */

typedef struct {
    /* constant */
    uint64_t magic;
    int64_t period; /* ns */
    double voltage_min, voltage_max, y_min, y_max;
    char identity[16];
    /* written by the host, a cache line of its own */
    _Alignas(64) volatile double u;
    volatile uint64_t commands;
    /* written by the card, likewise */
    _Alignas(64) volatile uint64_t begun;
    volatile double y, u_applied;
    volatile uint64_t counter;
} pea_registers;

_Static_assert(sizeof(pea_registers) == 192, "layout of the registers");
#endif
