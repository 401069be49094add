"""Three Python processes that hand three numbers on through pipes: the ring without middleware.

``python -m pea_bench.peers.pipe_ring SECONDS`` prints the loops a second. All on one
core: a wake-up across cores costs more than all the rest.
"""

from __future__ import annotations

import os
import struct
import sys
import time

SIZE = 3
RECORD = struct.Struct("<qdd")


def forward(source: int, sink: int) -> None:
    """Hand on until the ring is closed."""
    while data := os.read(source, RECORD.size):
        k, x, v = RECORD.unpack(data)
        os.write(sink, RECORD.pack(k, x + 1.0, v))


def main() -> None:
    """Drive the ring."""
    seconds = float(sys.argv[1])
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    pipes = [os.pipe() for _ in range(SIZE)]
    children = []
    for role in range(1, SIZE):
        child = os.fork()
        if not child:
            source, sink = pipes[role - 1][0], pipes[role][1]
            for end in {end for pipe in pipes for end in pipe} - {source, sink}:
                os.close(end)
            forward(source, sink)
            os._exit(0)
        children.append(child)
    source, sink = pipes[-1][0], pipes[0][1]
    for end in {end for pipe in pipes for end in pipe} - {source, sink}:
        os.close(end)
    k, x = 0, 0.0
    started = now = time.monotonic()
    while now - started < seconds:
        os.write(sink, RECORD.pack(k, x, 0.0))
        k, x, _ = RECORD.unpack(os.read(source, RECORD.size))
        k += 1
        now = time.monotonic()
    print(k / (now - started), flush=True)
    os.close(sink)
    for child in children:
        os.waitpid(child, 0)


if __name__ == "__main__":
    main()
