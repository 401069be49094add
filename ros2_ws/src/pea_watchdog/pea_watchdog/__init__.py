"""A process that brings the amplifier to its safe voltage when the plant cannot.

May import: the standard library alone, so that the process starts in some 30 ms.
"""
