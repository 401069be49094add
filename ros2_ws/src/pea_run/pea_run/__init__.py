"""An experiment made to run: the three modes, recorder, player, doctor.

May import: pea_report and below; rclpy.
"""
