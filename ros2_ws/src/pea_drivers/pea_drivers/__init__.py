"""Drivers of real amplifiers and sensors, each with the emulated device it is rehearsed on.

May import: pea_plant and below; no rclpy.
"""

import pea_plant.drivers  # noqa: F401  first: its table of drivers imports the modules here
