"""Drivers of real amplifiers and sensors, each with the emulated device it is rehearsed on.

May import: pea_plant and below; no rclpy.
"""
