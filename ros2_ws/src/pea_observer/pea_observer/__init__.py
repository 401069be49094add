"""State observers for the piezoelectric actuator."""
