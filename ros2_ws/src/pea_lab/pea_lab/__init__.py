"""Theory and simulation of experiments: linear analysis, margins, tuning, sweeps, comparison.

May import: pea_experiment and below; no rclpy.
"""
