"""An experiment: its file, its blocks, its rig, its score.

May import: pea_record and below; no rclpy.
"""
