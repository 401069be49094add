"""V: linear vibration dynamics from effective voltage to displacement."""
