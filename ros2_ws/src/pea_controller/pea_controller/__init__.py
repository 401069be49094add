"""Tracking controllers for the piezoelectric actuator."""
