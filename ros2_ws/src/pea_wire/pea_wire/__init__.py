"""Signals as ROS messages in bytes: topics, codecs, events, diagnostics.

May import: pea_core and pea_engine; no rclpy.
"""
