"""Factors of units that stand in no table of signals."""

SECOND = 1_000_000_000
"""Nanoseconds of a second: stamps and sample periods count nanoseconds."""

NS = 1e-9
"""Seconds of a nanosecond."""

NM = 1e-9
"""Metres of a nanometre."""

NM_PER_M = 1e9
"""Nanometres of a metre."""
