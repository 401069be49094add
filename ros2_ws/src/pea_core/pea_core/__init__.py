"""Contracts of the pea control loop: blocks, signals, parameters, the loop itself."""
