"""LabJack of the T series as an analogue output and an input, over Modbus TCP."""

from pea_drivers.modbus_daq.device import Params, make

__all__ = ["Params", "make"]
