"""Simulated or real piezoelectric actuator, its amplifier, its sensor, and the safety gate.

May import: pea_ros and below, no other block; rclpy in node modules only.
"""
