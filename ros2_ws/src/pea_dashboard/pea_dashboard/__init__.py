"""The page in the browser: watch, tune, stop.

May import: pea_run and below; rclpy.
"""
