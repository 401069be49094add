"""How well a loop in wall time keeps its deadlines.

Sample k is due at t_0 + k T_s. Its lateness is from there to its begin. It is missed where it has
not ended by t_0 + (k + 1) T_s; missed samples in a row are one burst.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pea_core.units import SECOND

PARTS = 64
"""Bins from each power of two to the next: a quantile is at most 1.6 % too high."""

SHORTEST_NS = 64
"""What is less late is drawn as this late."""

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


def bin_of(ns: np.ndarray) -> np.ndarray:
    """Bin of each lateness (ns, 0 or more): `PARTS` of equal width for each power of two."""
    fraction, power = np.frexp(ns.astype(float))
    bins: np.ndarray = power * PARTS + ((2.0 * fraction - 1.0) * PARTS).astype(np.int64)
    return np.where(ns > 0, bins, 0)


def edge(bins: np.ndarray) -> np.ndarray:
    """Lower edge (ns) of each bin."""
    power, part = np.divmod(bins, PARTS)
    edges: np.ndarray = np.ldexp((1.0 + part / PARTS) / 2.0, power)
    return np.where(bins > 0, edges, 0.0)


class Deadlines:
    """Lateness of a run, kept as a histogram: its size does not grow with the run.

    Parameters
    ----------
    T_ns : int
        Sample period (ns).

    Attributes
    ----------
    samples, missed, bursts, longest_burst : int
        Counts.
    latest : int
        Largest lateness (ns).
    conditions : dict
        Under which the loop ran, for the metrics.
    """

    def __init__(self, T_ns: int) -> None:
        self.T_ns = T_ns
        self.conditions: dict[str, Any] = {}
        self.samples = self.missed = self.bursts = self.longest_burst = 0
        self.latest = 0
        self.counts = np.zeros(64 * PARTS, np.int64)
        self._burst = 0
        self._began = self._last = 0

    def add(self, times: np.ndarray) -> None:
        """Count some more samples.

        Parameters
        ----------
        times : (n, 2) array of int64
            How long after its deadline each sample has begun and ended (ns).
        """
        if not len(times):
            return
        late, ended = times.T
        if not self.samples:
            self._began = int(late[0])
        self.samples += len(late)
        self._last = (self.samples - 1) * self.T_ns + int(late[-1])
        self.latest = max(self.latest, int(late.max()))
        self.counts += np.bincount(bin_of(late), minlength=len(self.counts))
        missed = ended > self.T_ns
        self.missed += int(missed.sum())
        for length, starts in _rows(missed, self._burst):
            self.bursts += starts
            self.longest_burst = max(self.longest_burst, length)
            self._burst = length
        if not missed[-1]:
            self._burst = 0

    def join(self, other: Deadlines) -> None:
        """Count another run, too; its rate and its bursts stay its own."""
        self.samples += other.samples
        self.missed += other.missed
        self.bursts += other.bursts
        self.longest_burst = max(self.longest_burst, other.longest_burst)
        self.latest = max(self.latest, other.latest)
        self.counts += other.counts

    @property
    def missed_fraction(self) -> float:
        """Share of the samples that were missed."""
        return self.missed / max(self.samples, 1)

    def tail(self) -> list[tuple[float, float]]:
        """Lateness (us), and the share of samples that are later; where it changes."""
        bins = np.flatnonzero(self.counts)
        later = 1.0 - np.cumsum(self.counts)[bins] / max(self.samples, 1)
        return list(zip((edge(bins + 1) / 1e3).tolist(), later.tolist()))

    def quantile(self, q: float) -> float:
        """Lateness (ns) that the share q of the samples does not exceed; from above, to a bin."""
        if not self.samples:
            return 0.0
        at = int(np.searchsorted(np.cumsum(self.counts), q * self.samples))
        return min(float(edge(np.array(at + 1))), float(self.latest))

    @property
    def rate_hz(self) -> float:
        """Samples a second, from the first to the last."""
        took = self._last - self._began
        return (self.samples - 1) * SECOND / took if took > 0 else 0.0

    def figures(self) -> dict[str, Any]:
        """What ``metrics.json`` says of it; lateness in us."""
        return {
            "rate_hz": self.rate_hz,
            "missed_fraction": self.missed_fraction,
            "missed": self.missed,
            "bursts": self.bursts,
            "longest_burst": self.longest_burst,
            **{f"lateness_us_{name}": self.quantile(q) / 1e3 for name, q in QUANTILES.items()},
            "lateness_us_max": self.latest / 1e3,
        }

    def exchange(self) -> dict[str, Any]:
        """The same of times that exchanges took (us)."""
        names = {f"exchange_us_{name}": self.quantile(q) / 1e3 for name, q in QUANTILES.items()}
        return {**names, "exchange_us_max": self.latest / 1e3}

    def draw(self, path: Path, title: str) -> None:
        """Draw the histogram, and the share of samples later than a time; of one sample or more.

        Parameters
        ----------
        path : Path
            PNG to write.
        title : str
            Over the figure.
        """
        from pea_lab.plot import plt, save

        first, last = bin_of(np.array([SHORTEST_NS, max(self.latest, SHORTEST_NS)]))
        bins = np.arange(first, last + 2)
        us = np.maximum(edge(bins), SHORTEST_NS) / 1e3
        counts = self.counts[bins]
        counts[0] += self.counts[:first].sum()
        later = 1.0 - np.cumsum(counts) / self.samples
        starts = np.arange(0, len(bins), PARTS // 4)
        plot, (histogram, tail) = plt.subplots(1, 2, figsize=(12, 4.5), constrained_layout=True)
        figures = self.figures()
        plot.suptitle(
            f"{title}: {self.samples} samples at {self.rate_hz:.6g} Hz, "
            f"{self.missed} missed ({figures['missed_fraction']:.3%}) in {self.bursts} bursts"
        )
        histogram.step(us[starts], np.add.reduceat(counts, starts), where="post")
        histogram.set(title="Lateness", ylabel="samples", xscale="log", yscale="log")
        tail.step(us, np.maximum(later, 0.1 / self.samples), where="post")
        tail.set(title="Share of samples that are later", xscale="log", yscale="log")
        for name, q in QUANTILES.items():
            tail.axhline(1.0 - q, color="tab:gray", linewidth=0.8)
            text = f" {name} {figures[f'lateness_us_{name}']:.3g} us"
            tail.text(us[0], 1.0 - q, text, va="bottom", fontsize="small")
        for axis in (histogram, tail):
            axis.axvline(self.T_ns / 1e3, color="tab:red", linewidth=0.8, label="T_s")
            axis.set(xlabel="lateness (us)")
            axis.grid(True, alpha=0.3)
            axis.legend(loc="upper right")
        save(plot, path)


def _rows(missed: np.ndarray, before: int) -> list[tuple[int, bool]]:
    """Length of each row of True, and whether it starts here; `before` were so just before."""
    steps = np.flatnonzero(np.diff(missed, prepend=False, append=False)).reshape(-1, 2)
    return [
        (int(end - start) + (before if start == 0 else 0), start > 0 or before == 0)
        for start, end in steps.tolist()
    ]
