"""Configuration and launch files of pea.

May import: pea_core; launch and launch_ros.
"""
