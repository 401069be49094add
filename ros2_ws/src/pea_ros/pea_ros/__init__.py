"""The shell of a ROS node: transport, parameters, discovery.

May import: pea_wire and below; rclpy.
"""
