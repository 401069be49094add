"""Compiled drivers, called from the compiled loop, and boards that stand for devices.

May import: pea_drivers and below; no rclpy.

A driver of this package is a shared library of `examples/native/pea_driver.h`. `library` loads and
checks it, `device` makes a driver of it, `cycle` is the compiled cycle of a sample, `driven` the
plant of a loop in wall time, `board` the other side of the line.
"""

import pea_plant.drivers  # noqa: F401  first: its table of drivers imports the modules here
