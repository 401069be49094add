"""Recordings: write, read, recover, cut, export MCAP.

May import: the blocks' models and below; no rclpy.
"""
