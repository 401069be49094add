"""NV200/D of piezosystem jena, over a serial line or Telnet."""

from pea_drivers.nv200.device import Params, make

__all__ = ["Params", "make"]
