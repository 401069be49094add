"""Stages drawn at random, and a simulator of them that shares no code with the product.

Modes are stepped with matrix exponentials of their real state space, one signal before and one
after the fraction of the delay; creep likewise. H: play operators sample by sample, Preisach as a
sum over the history's extrema, Bouc-Wen by Runge-Kutta steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, ss2tf

T_S = 5e-5


@dataclass
class Stage:
    """A stage: modes (Hz, damping, m/V), delay (s), H, creep, noise (m)."""

    f: np.ndarray
    zeta: np.ndarray
    K: np.ndarray
    delay: float
    H: str = "none"
    h: dict = field(default_factory=dict)
    tau: np.ndarray = field(default_factory=lambda: np.empty(0))
    weights: np.ndarray = field(default_factory=lambda: np.empty(0))
    noise: float = 0.7e-9
    T_s: float = T_S

    @property
    def small(self) -> float:
        """Gain for small signals after a turn (m/V), without creep."""
        slope = {
            "none": lambda: 1.0,
            "prandtl_ishlinskii": lambda: self.h["w"][0],
            "preisach": lambda: 1.0 - self.h["share"],
            "bouc_wen": lambda: 1.0 - self.h["alpha"],
        }[self.H]()
        return float(self.K.sum() * slope)

    def true(self, u: np.ndarray) -> np.ndarray:
        """Displacement (N,) without noise, from rest."""
        v = hysteresis(self.H, self.h, u)
        v = creep(v, self.tau, self.weights, self.T_s)
        return sum(
            mode(v, f, z, K, self.delay, self.T_s)
            for f, z, K in zip(self.f, self.zeta, self.K, strict=True)
        )

    def measured(self, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Displacement (N,) with noise."""
        return self.true(u) + self.noise * rng.standard_normal(len(u))


def held(A: np.ndarray, B: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
    n = len(A)
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n:] = A * t, B * t
    E = expm(M)
    return E[:n, :n], E[:n, n:]


def mode(v: np.ndarray, f: float, zeta: float, K: float, delay: float, T_s: float) -> np.ndarray:
    w = 2.0 * np.pi * f
    A = np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]])
    B, C = np.array([[0.0], [K * w * w]]), np.array([[1.0, 0.0]])
    n = int(delay / T_s)
    rest = delay - n * T_s
    A_d, _ = held(A, B, T_s)
    onward, B_now = held(A, B, T_s - rest)
    B_before = onward @ held(A, B, rest)[1]
    y = np.zeros(len(v))
    for B_d, lag in ((B_now, n), (B_before, n + 1)):
        num, den = ss2tf(A_d, B_d, C, np.zeros((1, 1)))
        y += lfilter(num[0], den, np.concatenate([np.zeros(lag), v[: len(v) - lag]]))
    return y


def creep(v: np.ndarray, tau: np.ndarray, weights: np.ndarray, T_s: float) -> np.ndarray:
    out = v.astype(float)
    for t, w in zip(tau, weights, strict=True):
        a = np.exp(-T_s / t)
        z = lfilter([1.0 - a], [1.0, -a], np.concatenate([[0.0], v[:-1]]))
        out = out + w * z
    return out


def hysteresis(type: str, h: dict, u: np.ndarray) -> np.ndarray:
    if type == "none":
        return u.astype(float)
    if type == "prandtl_ishlinskii":
        r, w = h["r"], h["w"]
        z, out = np.zeros(len(r)), np.empty(len(u))
        for k, x in enumerate(u):
            z = np.minimum(x + r, np.maximum(x - r, z))
            out[k] = w @ z
        return out
    if type == "bouc_wen":
        return bouc_wen(u, h["alpha"], h["beta"], h["gamma"])
    return preisach(u, h["low"], h["high"], h["share"])


def bouc_wen(u: np.ndarray, alpha: float, beta: float, gamma: float) -> np.ndarray:
    """v = u - h, dh = alpha du - beta |du| h - gamma du |h|, Runge-Kutta in at most 0.5 V."""
    out, h, last = np.empty(len(u)), 0.0, 0.0
    for k, x in enumerate(u.tolist()):
        du = x - last
        steps = 1 + int(abs(du) / 0.5)
        d = du / steps
        a = abs(d)
        for _ in range(steps):
            s1 = alpha * d - beta * a * h - gamma * d * abs(h)
            g = h + 0.5 * s1
            s2 = alpha * d - beta * a * g - gamma * d * abs(g)
            g = h + 0.5 * s2
            s3 = alpha * d - beta * a * g - gamma * d * abs(g)
            g = h + s3
            s4 = alpha * d - beta * a * g - gamma * d * abs(g)
            h += (s1 + 2.0 * s2 + 2.0 * s3 + s4) / 6.0
        last = x
        out[k] = x - h
    return out


def preisach(u: np.ndarray, low: float, high: float, share: float) -> np.ndarray:
    """Uniform density on low <= beta <= alpha <= high: a reduced memory of extrema."""
    width = high - low
    memory = [low]  # alternating extrema: minimum, maximum, minimum, ...
    out, last, rising = np.empty(len(u)), 0.0, True

    def area(points: list[float], x: float, up: bool) -> float:
        total, seq = 0.0, [*points, x]
        for i in range(1, len(seq)):
            d = seq[i] - seq[i - 1]
            total += d * d if d > 0 else -d * d
        return total / width

    zero = area([low], 0.0, True)
    for k, x in enumerate(u.tolist()):
        x = min(max(x, low), high)
        if x > last:
            if not rising:
                memory.append(last)
                rising = True
            while len(memory) >= 3 and x >= memory[-2]:
                del memory[-2:]
        elif x < last:
            if rising:
                memory.append(last)
                rising = False
            while len(memory) >= 3 and x <= memory[-2]:
                del memory[-2:]
        last = x
        out[k] = (1.0 - share) * x + share * (area(memory, x, rising) - zero)
    return out


def draw(seed: int) -> Stage:
    """A stage at random: what an identification must stand."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    while True:
        f = np.sort(np.exp(rng.uniform(np.log(300.0), np.log(4000.0), n)))
        if n == 1 or (f[1:] / f[:-1]).min() > 1.15:
            break
    zeta = np.exp(rng.uniform(np.log(0.005), np.log(0.8), n))
    share = np.exp(rng.uniform(np.log(0.02), 0.0, n))
    K = 0.14e-6 * share / share.sum()
    delay = float(rng.uniform(0.0, 10.0)) * T_S
    H = ("none", "prandtl_ishlinskii", "preisach", "bouc_wen")[int(rng.integers(4))]
    h: dict = {}
    if H == "prandtl_ishlinskii":
        count = int(rng.integers(5, 12))
        r = np.concatenate([[0.0], np.sort(rng.uniform(1.0, 40.0, count))])
        w = np.concatenate([[rng.uniform(0.5, 0.8)], rng.uniform(0.2, 1.0, count)])
        w[1:] *= (1.0 - w[0]) / w[1:].sum()
        h = {"r": r, "w": w}
    elif H == "preisach":
        h = {
            "low": -rng.uniform(10.0, 60.0),
            "high": rng.uniform(100.0, 150.0),
            "share": rng.uniform(0.1, 0.4),
        }
    elif H == "bouc_wen":
        beta = rng.uniform(0.01, 0.08)
        h = {"alpha": rng.uniform(0.1, 0.45), "beta": beta, "gamma": beta * rng.uniform(-0.5, 0.9)}
    tau, weights = np.empty(0), np.empty(0)
    if rng.random() < 0.5:
        tau, weights = np.array([0.05, 0.5, 5.0, 50.0]), np.full(4, rng.uniform(0.003, 0.015))
    return Stage(f, zeta, K, delay, H, h, tau, weights, noise=rng.uniform(0.2, 2.0) * 1e-9)
