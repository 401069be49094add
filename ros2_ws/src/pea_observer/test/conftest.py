from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.signal import cont2discrete

from pea_core.block import Block
from pea_core.nominal import NominalModel
from pea_core.signals import Measurement

MODEL = NominalModel()
A = np.array([[0.0, 1.0], [-(5450.0**2), -2.0 * 0.82 * 5450.0]])
B = np.array([[0.0], [0.142e-6 * 5450.0**2]])
C = np.array([[1.0, 0.0]])


class Bench:
    """A plant of its own (scipy's zero-order hold) and an observer that looks at it."""

    T_s = 50e-6

    def sampled(self, T_s: float = T_s) -> tuple[np.ndarray, np.ndarray]:
        F, G, *_ = cont2discrete((A, B, C, np.zeros((1, 1))), T_s)
        return F, G[:, 0]

    def plant(
        self, u: np.ndarray, eps: Any = 0.0, T_s: float = T_s, x0: Any = (0.0, 0.0)
    ) -> np.ndarray:
        """States (n + 1, 2); u[k] and eps[k] act from sample k to sample k + 1."""
        F, G = self.sampled(T_s)
        v = u + np.broadcast_to(eps, u.shape)
        x = np.zeros((u.size + 1, 2))
        x[0] = x0
        for k in range(u.size):
            x[k + 1] = F @ x[k] + G * v[k]
        return x

    def watch(
        self, block: Block, y: np.ndarray, u: np.ndarray, y_dot: np.ndarray | None = None
    ) -> np.ndarray:
        """Estimates (n + 1, 3) of `block`, told y[k] and the voltage of the interval before."""
        before = np.concatenate([[0.0], u])
        rows = np.empty((y.size, 3))
        for k in range(y.size):
            slope = float("nan") if y_dot is None else float(y_dot[k])
            rows[k] = block.output(Measurement(float(y[k]), slope, float(before[k])))
            block.update()
        return rows


@pytest.fixture(scope="session")
def bench() -> Bench:
    return Bench()


@pytest.fixture(scope="session")
def drive() -> Callable[[int], np.ndarray]:
    """Voltage of n samples with slow and fast parts."""

    def voltage(n: int) -> np.ndarray:
        t = np.arange(n) * 50e-6
        return 40.0 + 30.0 * np.sin(2 * np.pi * 70.0 * t) + 2.0 * np.sin(2 * np.pi * 2300.0 * t)

    return voltage


def _poles(model: Any, c: Any) -> np.ndarray:
    """Eigenvalues of the state's map over one sample with y = 0 and u = 0, by unit states."""
    State = type(model.start(c))
    rest, n = Measurement(0.0, 0.0, 0.0), len(State._fields)
    columns = []
    for i in range(n):
        s = State(*np.eye(n)[i].tolist())
        columns.append(model.update(c, s, rest, model.output(c, s, rest)))
    return np.linalg.eigvals(np.array(columns).T)


@pytest.fixture(scope="session")
def poles() -> Callable[[Any, Any], np.ndarray]:
    return _poles
