"""Measured voltage and displacement, of a recording or a file of others, and a plant along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core import config
from pea_core.config import Source
from pea_core.injection import Plan, plan
from pea_core.live import WARM
from pea_core.params import ParameterError
from pea_core.units import NM_PER_M
from pea_engine.compiled import wanted
from pea_engine.kernels import drive_kernel
from pea_experiment.experiment import SCHEMAS
from pea_identify import files
from pea_identify.files import Asked, Found
from pea_identify.records import Record, record
from pea_plant.drivers.simulated import Simulated
from pea_plant.plant import Params as PlantParams
from pea_record import frame
from pea_record.read import load
from pea_report import recorded, replay
from pea_wire.topics import NAMESPACE


def is_recording(path: Path) -> bool:
    """Whether a path is a bag's directory or an MCAP file."""
    return path.is_dir() or path.suffix == ".mcap"


def read(path: Path, asked: Asked = files.NOTHING) -> Found:
    """Records of a recording or of a file.

    Raises
    ------
    BagError, ParameterError
        It cannot be read, or something that it needs is not said.
    """
    if not is_recording(path):
        return files.read(path, asked)
    for option, text in (("--u", asked.u), ("--y", asked.y), ("--time", asked.time)):
        if text:
            raise ParameterError(f"{option} {text}: a recording says its columns itself; omit it")
    table = frame.load(path)
    columns = table.select("t", "u_applied", "y")
    t, u, y = columns["t"], columns["u_applied"], columns["y"]
    T_s = table.T_s
    if len(t) > 1 and np.abs(np.diff(t) - T_s).max() > 0.01 * T_s:
        k = int(np.argmax(np.abs(np.diff(t) - T_s)))
        raise ParameterError(
            f"{path.name}: samples are missing after {t[k]:.6g} s: cut it there with pea bag cut"
        )
    # u_applied belongs to the interval that ended at the stamp
    u, y = u[1:], y[:-1]
    found = [] if asked.kind or asked.period else injected(path, len(u), round(t[0] / T_s), T_s)
    records = []
    for span in found:
        blocks = []
        first = span.start + span.plan.wait
        for _ in range(span.plan.blocks):
            blocks.append((first + span.plan.N, span.plan.periods))
            first += (1 + span.plan.periods) * span.plan.N
        # checked in one piece, and without the way to the operating point
        begin = span.start + span.plan.wait
        record(u[begin:first], y[begin:first], T_s, path.name, "general")
        records.append(
            replace(
                record(u, y, T_s, path.name, "general"),
                kind="periodic",
                period=span.plan.N,
                blocks=tuple(blocks),
                lines=tuple(span.plan.lines[0].tolist()),
            )
        )
    if not records:
        records = [record(u, y, T_s, path.name, asked.kind, asked.period)]
    made = records[0]
    kind = f"{made.kind}, period {made.period} samples" if made.period else made.kind
    if made.blocks:
        kind += f", {sum(len(r.blocks) for r in records)} realisations injected"
    said = f"{path.name}: u_applied (V) and y (m) of the recording, {1.0 / T_s:g} Hz"
    return Found(records, f"{said}; {len(made.u)} samples, {kind}")


class Span(NamedTuple):
    """Multisines that a controller injected.

    Attributes
    ----------
    start : int
        Row at which they were switched on.
    plan : Plan
    """

    start: int
    plan: Plan


def injected(path: Path, samples: int, first: int, T_s: float) -> list[Span]:
    """When the controller of a recording injected whole multisines.

    Parameters
    ----------
    path : Path
        The recording.
    samples : int
        Rows of it.
    first : int
        Number of the first sample.
    T_s : float
        Sample period (s).
    """
    recording = load(path)
    params: Any = recorded.experiment_of(recording, path).nodes["controller"].params
    begun: list[tuple[int, Any]] = []
    if not first:  # else nothing says how long it has been on
        begun.append((0, getattr(params, "inject", None)))
    schema = SCHEMAS["controller"]
    for event in recording.events:
        if event.node != f"{NAMESPACE}/controller":
            continue
        before = params
        params = replay.followed(schema, params, event.asked)
        if getattr(params, "inject", None) == getattr(before, "inject", None):
            continue
        k = -(-event.stamp // recording.T_ns)
        if type(params) is not type(before):  # another law takes over later
            k += max(math.ceil(WARM / T_s), 1)
        begun.append((k - first, getattr(params, "inject", None)))
    found = []
    ends = [k for k, _ in begun[1:]] + [samples]
    for (start, values), end in zip(begun, ends, strict=True):
        if values is None or values.where == "off" or values.kind != "multisine":
            continue
        made = plan(values, T_s)
        whole = (end - start - made.wait) // ((1 + made.periods) * made.N)
        if start >= 0 and whole > 0:  # blocks that were cut short do not count
            found.append(Span(start, made._replace(lines=made.lines[:whole])))
    return found


def driven(
    measured: Record, path: Path, plant: Path | None, sets: Sequence[str]
) -> tuple[np.ndarray, str]:
    """Displacement (N,) of a plant along a measured voltage, and which plant it was.

    The plant's noise is off. Of a recording u is what was applied, so its delay is in it already.

    Raises
    ------
    ParameterError
        Neither a plant is given nor does the file say one, or its parameters do not go together.
    """
    sources = [Source({"T_s": measured.T_s}, "the data")]
    of_bag = is_recording(path)
    if plant is not None:
        values = config.read(plant, ("plant",))["plant"]
        values.pop("T_s", None)
        sources.append(Source(config.absolute(values, plant.parent), str(plant)))
        source = str(plant)
    elif of_bag:
        experiment = recorded.experiment_of(load(path), path)
        sources.append(Source({**experiment.nodes["plant"].values, "preset": ""}, str(path)))
        source = f"of {path}"
    else:
        raise ParameterError(
            f"{path.name}: says no plant: give --plant FILE, for example plant.yaml of pea identify"
        )
    given = {}
    for text in sets:
        name, equals, value = text.partition("=")
        if not equals:
            raise ParameterError(f"--set {text!r}: write PARAM=VALUE")
        given[name.strip().removeprefix("plant.")] = config.parse(value)
    sources.append(Source(given, "the command line"))
    params: Any = config.resolve("plant", PlantParams, sources).params
    quiet = replace(params.sensor, noise_nm=0.0)
    params = replace(params, sensor=quiet, delay_samples=0 if of_bag else params.delay_samples)
    made = Simulated(params=params, T_s=measured.T_s)
    u = np.ascontiguousarray(measured.u[:, 0])
    seen = np.empty((len(u), 4))
    if wanted(len(u)):
        made.s = drive_kernel(made.model)(made.c, made.s, made.noise(len(u)), u, seen)
    else:
        for k, u_k in enumerate(u.tolist()):
            seen[k, 0] = made.read().y
            made.write(u_k)
    return seen[:, 0].copy(), source


def draw(measured: Record, model: np.ndarray, there: Path) -> None:
    """Both displacements, and the error below, as PNG."""
    from matplotlib.figure import Figure

    if there.exists():
        raise ParameterError(f"--out {there}: already exists; name a new file")
    t = np.arange(len(model)) * measured.T_s
    every = max(1, len(t) // 20_000)
    y = measured.y[:, 0]
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.plot(t[::every], y[::every] * 1e6, lw=0.8, label="measured")
    top.plot(t[::every], model[::every] * 1e6, lw=0.8, label="plant along the measured voltage")
    top.set_ylabel("displacement (µm)")
    top.legend()
    bottom.plot(t[::every], (model - y)[::every] * NM_PER_M, lw=0.6)
    bottom.set_ylabel("error (nm)")
    bottom.set_xlabel("time (s)")
    figure.savefig(there, dpi=110)
