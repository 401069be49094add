"""Measurements of a stage and of its running loop: what is driven, and what it shows.

May import: pea_lab, pea_identify and below; no rclpy.
"""
