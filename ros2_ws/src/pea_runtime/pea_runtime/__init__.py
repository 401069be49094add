"""Experiments, the three ways to run the loop, recorder, metrics, report, command line."""
