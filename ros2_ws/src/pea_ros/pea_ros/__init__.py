"""Everything of pea that knows rclpy: topics, parameters, the node shell."""
