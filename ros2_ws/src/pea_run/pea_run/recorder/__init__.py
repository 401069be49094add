"""Recordings: one format, a rosbag2 bag, written and read alike by every mode."""
