"""Configuration and launch files of pea."""
