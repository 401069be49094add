"""Simulated or real piezoelectric actuator, its amplifier, its sensor, and the safety gate."""
