"""The loop in a browser: look at it, tune it, stop it. Never a part of the loop."""
