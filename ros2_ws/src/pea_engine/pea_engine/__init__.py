"""The loop compiled and in wall time: kernels, lanes, pacing.

May import: pea_core; no ROS, no physics.
"""
