"""The command pea: one module a command, nothing computed.

May import: all other packages; rclpy only through them.
"""
