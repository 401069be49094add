"""Breaks off what a driver does beyond its time, so that the main thread goes on.

A driver of a lab's own may wait for ever. The watchdog then brings the stage to rest; this lets
the plant say so, answer its services and end when it is told.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import threading
import time
from collections.abc import Iterator

from pea_plant.drivers.driver import DriverError
from pea_plant.rig import Rig

LOOK = 0.1
"""Seconds between two looks at the time."""

DEAF = 1.0
"""Seconds that a driver has to be broken off; one that is deaf ends with its process."""

ENDS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def breaking(rig: Rig) -> Iterator[None]:
    """Raise a `DriverError` in the main thread where the rig's driver is over its time.

    What waits in compiled code hears no signal. There SIGINT and SIGTERM end the process; the
    watchdog sees that.
    """
    main = threading.get_ident()
    over = threading.Event()
    near, far = os.pipe()
    os.set_blocking(far, False)
    usual = signal.set_wakeup_fd(far, warn_on_full_buffer=False)

    def ring(number: int, frame: object) -> None:
        if rig.hangs:
            rig.until = math.inf
            raise DriverError(f"no answer within {rig.allowed:g} s")

    def look() -> None:
        asked = False
        while not over.is_set():
            if select.select([near], [], [], LOOK)[0]:
                asked = asked or any(n in ENDS for n in os.read(near, 4096))
            if not rig.hangs:
                continue
            if asked and time.monotonic() > rig.until + DEAF:
                os.write(2, b"plant: ended while the driver does not come back\n")
                os._exit(3)
            signal.pthread_kill(main, signal.SIGALRM)

    before = signal.signal(signal.SIGALRM, ring)
    thread = threading.Thread(target=look, name="alarm", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        os.write(far, b"\0")
        thread.join()
        signal.signal(signal.SIGALRM, before)
        signal.set_wakeup_fd(usual)
        os.close(near)
        os.close(far)
