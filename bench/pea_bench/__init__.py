"""How fast everything is, each measure beside its yardstick in the same run: ``pea bench``."""
