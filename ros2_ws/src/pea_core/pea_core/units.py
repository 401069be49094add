"""Factors of units that stand in no table of signals."""

SECOND = 1_000_000_000
"""Nanoseconds of a second: stamps and sample periods count nanoseconds."""
