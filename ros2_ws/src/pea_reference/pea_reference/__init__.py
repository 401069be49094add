"""Desired displacement and its exact derivatives."""
