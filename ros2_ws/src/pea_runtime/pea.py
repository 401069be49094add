"""The library by its short name: ``pea.load`` and ``pea.simulate``."""

from pea_runtime import load, simulate

__all__ = ["load", "simulate"]
