"""PI controllers by the General Command Set 2.0: E-709, E-712, E-727, E-754, E-873."""

from pea_drivers.gcs.device import Params, make, several

__all__ = ["CHANNEL", "Params", "make", "several"]

CHANNEL = "axis"
"""The parameter of a driver that chooses a channel of the device."""
