"""What the plant node can drive: for now, the simulated actuator."""
