"""State observers for the piezoelectric actuator.

May import: pea_ros and below, no other block; rclpy in node modules only.
"""
