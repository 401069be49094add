"""What a recording shows: replay, figures, pages.

May import: pea_lab and below; no rclpy.
"""
