"""Desired displacement and its exact derivatives.

May import: pea_ros and below, no other block; rclpy in node modules only.
"""
