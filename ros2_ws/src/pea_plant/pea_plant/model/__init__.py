"""The actuator of Fig 2, block by block: H, V, F_c, and the sensor behind them."""
