"""Contracts of the control loop: blocks, signals, parameters, the loop itself.

May import: no other package of pea, no ROS.
"""
