"""Controllers, observers and plants against each other: the same experiment for each combination.

Every combination runs as in batch mode, without a recording, on all cores. One that is unstable
on the nominal plant, or whose loop cannot go on, is told in its row.
"""

from __future__ import annotations

import csv
import itertools
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import wait as waiting
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any

import numpy as np

from pea_controller import model as controllers
from pea_core.loop import LoopFault, blocks_of, trace
from pea_core.params import ParameterError
from pea_core.printable import printable
from pea_core.units import NM_PER_M
from pea_engine.compiled import wanted
from pea_experiment import experiments
from pea_experiment.experiment import Experiment
from pea_experiment.metrics import metrics, rms, transient, truth
from pea_lab.check import refuse
from pea_observer import model as observers
from pea_plant.gate import UnsafeCommand

CONTROLLERS = tuple(
    getattr(law.Params, "PRESET", name)
    for name, law in controllers.MODELS.items()
    if getattr(law, "COMPARED", False)
)
"""Presets of the laws that are compared where nobody names any."""

OBSERVERS = (observers.CHOICE.default,)
PLANTS = ("hysteresis_creep_noise", "hysteresis_creep_noise_delay")
"""What is compared where nobody says: PID, SMC, SMCBL and PIDSMC, without and with delay."""

WINDOWS = 400
"""Points of the curve of error over time: rms over as many pieces of the run."""

COLUMNS = (
    "controller",
    "observer",
    "plant",
    "frequency_hz",
    "rms_error_nm",
    "max_error_nm",
    "rms_error_percent",
    "rms_voltage_step_V",
    "overshoot_percent",
    "settling_time_ms",
    "saturated_samples",
    "failure",
)
"""Columns of ``compare.csv``: a row for the run, then one for each frequency of a series."""


@dataclass(frozen=True)
class Combination:
    """One run: the names it goes by, the experiment, and why it is not run, if so."""

    controller: str
    observer: str
    plant: str
    experiment: Experiment
    refusal: str


def combinations(
    name: str,
    sets: Sequence[str],
    controllers: Sequence[str],
    observers: Sequence[str],
    plants: Sequence[str],
    duration: float | None = None,
    force: bool = False,
) -> list[Combination]:
    """Every controller with every observer and plant; an empty list keeps the experiment's own.

    Raises
    ------
    ParameterError
        An unknown name, or a combination that does not go together.
    """
    found = []
    for plant, observer, controller in itertools.product(
        plants or ("",), observers or ("",), controllers or ("",)
    ):
        others = {"plant": plant, "observer": observer, "controller": controller}
        others = {node: choice for node, choice in others.items() if choice}
        experiment = experiments.load(name, sets, duration, others=others)
        refusal = ""
        if not force:
            try:
                refuse(experiment)
            except ParameterError as error:
                refusal = str(error).split(": ", 1)[1].split(";")[0]
        values = {node: experiment.nodes[node].values for node in ("observer", "controller")}
        found.append(
            Combination(
                controller or str(values["controller"]["preset"] or values["controller"]["type"]),
                observer or str(values["observer"]["preset"] or values["observer"]["type"]),
                plant or "as given",
                experiment,
                refusal,
            )
        )
    return found


_done: Synchronized | None = None


def _share(counter: Synchronized) -> None:
    global _done
    _done = counter
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ends without a word; the parent says it


def measured(combination: Combination) -> dict[str, Any]:
    """Run one combination: its names, its metrics, and its error over time.

    `failure` says why there are none.
    """
    experiment = combination.experiment
    row: dict[str, Any] = {
        "controller": combination.controller,
        "observer": combination.observer,
        "plant": combination.plant,
        "failure": combination.refusal,
    }
    if combination.refusal:
        return row
    loop = experiment.loop(wanted(experiment.samples))
    pieces = []
    try:
        for samples in blocks_of(experiment.samples):
            pieces.append(loop.run(samples))
            if loop.fault:
                raise loop.fault
            if _done is not None:
                with _done.get_lock():
                    _done.value += samples
    except (LoopFault, UnsafeCommand) as error:
        return row | {"failure": str(error)}
    samples = trace(pieces)
    true = truth(experiment.plant(), samples, experiment.nominal)
    assert true is not None
    plant = experiment.nodes["plant"].params
    row |= metrics(samples, true, experiment.segments, plant.voltage_min, plant.voltage_max)
    row |= transient(true["x1"], experiment.move, experiment.T_s)
    off = (true["x1"] - samples["w"]) * NM_PER_M
    windows = np.array_split(off, min(WINDOWS, len(off)))
    return row | {"curve_nm": [rms(window) for window in windows]}


def run(
    what: Sequence[Combination], progress: Callable[[int], None], processes: int | None = None
) -> list[dict[str, Any]]:
    """Run all combinations on all cores; rows in their order.

    Parameters
    ----------
    what : sequence of Combination
    progress : callable
        Told how many samples are done.
    processes : int, optional
        How many run at once; the number of cores where not given.
    """
    context = multiprocessing.get_context("spawn")
    counter = context.Value("q", 0)
    workers = min(processes or len(os.sched_getaffinity(0)), len(what))
    pool = ProcessPoolExecutor(workers, context, initializer=_share, initargs=(counter,))
    try:
        futures = [pool.submit(measured, combination) for combination in what]
        left: Any = futures
        while left:
            left = waiting(left, timeout=0.2).not_done
            progress(counter.value)
        return [future.result() for future in futures]
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def write(out: Path, name: str, rows: Sequence[dict[str, Any]], duration: float) -> None:
    """Write ``compare`` as ``.csv``, ``.json``, ``.png`` and ``.svg`` into a directory.

    Parameters
    ----------
    out : Path
        Existing directory.
    name : str
        Name of the experiment.
    rows : sequence of dict
        From `run`.
    duration : float
        Length of a run (s).
    """
    with (out / "compare.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS, extrasaction="ignore", restval="")
        table.writeheader()
        for row in rows:
            table.writerow(row)
            names = {key: row[key] for key in ("controller", "observer", "plant")}
            table.writerows(names | segment for segment in row.get("segments", ()))
    told = {"experiment": name, "rows": [without_curve(row) for row in rows]}
    (out / "compare.json").write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    draw(out / "compare.png", name, rows, duration)


def groups(rows: Sequence[dict[str, object]]) -> dict[str, list[dict[str, Any]]]:
    """Rows of one plant and observer together, by a title that names both."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(f"plant {row['plant']}, observer {row['observer']}", []).append(row)
    return found


def table(rows: Sequence[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Heads and cells of the table of a group; columns without a value are left out.

    Errors without a unit are in nm, those at a frequency rms.
    """
    frequencies = list(
        dict.fromkeys(s["frequency_hz"] for row in rows for s in row.get("segments", ()))
    )
    if len(frequencies) < 2:
        frequencies = []

    def cells(row: dict[str, Any]) -> dict[str, Any]:
        of = {s["frequency_hz"]: s["rms_error_nm"] for s in row.get("segments", ())}
        return {
            "controller": row["controller"],
            **{f"{f:g} Hz": of.get(f) for f in frequencies},
            "rms": row.get("rms_error_nm"),
            "max": row.get("max_error_nm"),
            "rms %": row.get("rms_error_percent"),
            "step V": row.get("rms_voltage_step_V"),
            "overshoot %": row.get("overshoot_percent"),
            "settling ms": row.get("settling_time_ms"),
            "": row["failure"] or None,
        }

    found = [cells(row) for row in rows]
    heads = [head for head in found[0] if any(row[head] is not None for row in found)]

    def shown(value: object) -> str:
        return "-" if value is None else value if isinstance(value, str) else f"{value:.3g}"

    return heads, [
        [shown(row[head]) if head else row[head] or "" for head in heads] for row in found
    ]


def without_curve(row: dict[str, object]) -> dict[str, Any]:
    """A row for the output: all but the curve for the plot."""
    return {key: value for key, value in row.items() if key != "curve_nm"}


def draw(path: Path, name: str, rows: Sequence[dict[str, Any]], duration: float) -> None:
    """Draw the error of every combination over time, one panel for each plant; also as SVG."""
    from pea_lab.plot import TITLE_MAX, plt, save, save_as

    plants = list(dict.fromkeys(row["plant"] for row in rows))
    plot, axes = plt.subplots(
        len(plants),
        1,
        figsize=(12, 4 * len(plants)),
        constrained_layout=True,
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    plot.suptitle(printable(f"{name}: tracking error", TITLE_MAX))
    several = len({row["observer"] for row in rows}) > 1
    for axis, plant in zip(axes[:, 0], plants):
        for row in rows:
            if row["plant"] != plant or "curve_nm" not in row:
                continue
            t = (np.arange(len(row["curve_nm"])) + 0.5) / len(row["curve_nm"]) * duration
            label = f"{row['controller']}, {row['observer']}" if several else row["controller"]
            label += f": {row['rms_error_nm']:.3g} nm"
            axis.semilogy(
                t, np.maximum(row["curve_nm"], 1e-3), linewidth=1.0, label=printable(label)
            )
        axis.set(title=printable(f"plant: {plant}", TITLE_MAX), ylabel="rms error (nm)")
        axis.grid(True, which="both", alpha=0.3)
        if axis.lines:
            axis.legend(loc="lower right", ncols=2)
    axes[-1, 0].set(xlabel="time (s)")
    save(plot, path)
    save_as(plot, path.with_suffix(".svg"))
