/* Frames between a host and a board over UDP: fixed layout, little-endian, 8-byte fields.
 *
 * host to board, 32 bytes:  magic, kind, sequence, u, spare
 * board to host, 64 bytes:  magic, kind, counter, y, u_applied, sequence, stamp, period
 * A LIMITS frame has voltage_min, voltage_max, y_min, y_max in place of y to stamp.
 *
 * HELLO(stream 1 or 0)  the board answers with LIMITS, and streams a SAMPLE each period to who
 *                       asked with 1; it answers with IDENTITY, too
 * COMMAND(u)            the board's output is u from its next sample on; no answer
 * ASK(u), LOOK          the same and nothing, each answered at once with the newest SAMPLE
 * SAFE(u)               as COMMAND, from whoever sends it
 */
#ifndef PEA_FRAME_H
#define PEA_FRAME_H

#include <stdint.h>

#define PEA_FRAME_HOST 0x43414550u  /* "PEAC" */
#define PEA_FRAME_BOARD 0x53414550u /* "PEAS" */

enum { PEA_HELLO = 1, PEA_COMMAND, PEA_ASK, PEA_LOOK, PEA_SAFE };
enum { PEA_SAMPLE = 1, PEA_LIMITS, PEA_IDENTITY };

typedef struct {
    uint32_t magic, kind;
    uint64_t sequence;
    double u;      /* V; of HELLO: 1 to be streamed to */
    uint64_t spare;
} pea_host_frame;

typedef struct {
    uint32_t magic, kind;
    uint64_t counter;  /* of the sample */
    union {
        struct {
            double y, u_applied;     /* m, V */
            uint64_t sequence;       /* of the command that the board has taken last */
            int64_t stamp;           /* ns, the board's clock */
        } sample;
        struct {
            double voltage_min, voltage_max, y_min, y_max;
        } limits;
        char identity[32];
    } is;
    int64_t period; /* ns */
    uint64_t spare;
} pea_board_frame;

_Static_assert(sizeof(pea_host_frame) == 32, "layout of the host's frames");
_Static_assert(sizeof(pea_board_frame) == 64, "layout of the board's frames");
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "frames are little-endian: swap the bytes of each field here"
#endif
#endif
