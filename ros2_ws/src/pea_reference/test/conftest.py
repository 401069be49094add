"""Derivatives by finite differences, and compiled functions."""

from types import FunctionType

import numpy as np
import pytest

EIGHTH_ORDER = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0.0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])


@pytest.fixture(scope="session")
def differences_agree():
    """Compare w' and w'' of a signal around sample k with differences of w and w'."""

    def check(signal, k, rel=1e-7):
        points = np.array([signal.at(k + i) for i in range(-4, 5)])
        slopes = EIGHTH_ORDER @ points[:, :2] / signal.T_s
        size = np.abs(points).max(axis=0)
        floor = 40 * np.finfo(float).eps * size[:2] / signal.T_s  # rounding of the differences
        w_dot, w_ddot = signal.at(k)[1:]
        assert slopes[0] == pytest.approx(w_dot, rel=rel, abs=floor[0] + 1e-25)
        assert slopes[1] == pytest.approx(w_ddot, rel=rel, abs=floor[1] + 1e-25)

    return check


@pytest.fixture(scope="session")
def is_continuous():
    """Check that w and w' of a signal move no faster around sample k than w' and w'' say."""

    def check(signal, k, reach=6):
        points = np.array([signal.at(k + i) for i in range(-reach, reach + 1)])
        moved = np.abs(np.diff(points[:, :2], axis=0))
        fastest = signal.T_s * np.abs(points[:, 1:]).max(axis=0)
        rounding = 8 * np.finfo(float).eps * np.abs(points[:, :2]).max(axis=0)
        assert (moved <= 1.001 * fastest + rounding + 1e-25).all()

    return check


@pytest.fixture(scope="session")
def compiled():
    """Compile a function and the plain functions it calls, all unchanged."""
    numba = pytest.importorskip("numba")

    def jit(f):
        names = dict(f.__globals__)
        for name in f.__code__.co_names:
            if isinstance(names.get(name), FunctionType):
                names[name] = jit(names[name])
        return numba.njit(FunctionType(f.__code__, names, f.__name__))

    return jit
