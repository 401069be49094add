"""Configuration and launch files of pea.

May import: pea_core, pea_plant; launch and launch_ros.
"""
