"""A recorded run once more: the blocks on what they were told, compared bit by bit.

The observer is fed the recorded displacement, the controller the recorded reference and state;
parameters change where they changed. An unchanged version says the same to the last bit on the
same machine. With other parameters it answers what the blocks would have said: in open loop,
since what was measured stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_controller import model as controller
from pea_core import config
from pea_core.block import changed
from pea_core.config import AXIS
from pea_core.live import LAW, OBSERVER, Live
from pea_core.loop import Horizon, LoopFault, command
from pea_core.params import Choice, ParameterError, flatten, specs
from pea_core.signals import (
    FINE,
    Reference,
    column_of,
    columns_of,
    command_of,
    estimate_of,
    measurement_of,
    pack_command,
    pack_estimate,
    place,
)
from pea_engine.compiled import wanted
from pea_engine.kernels import law_kernel, observer_kernel
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS, AnyExperiment, Experiment
from pea_experiment.metrics import Spread
from pea_observer import model as observer
from pea_record import large
from pea_record.large import empty, give_back, pieces
from pea_record.recording import BagError, Recording
from pea_report.recorded import RUN
from pea_wire.topics import LOOP, NAMESPACE, STATE, VOLTAGE

THROUGH = tuple(RUN)

ESTIMATE, COMMAND = (tuple(c.name for c in columns_of(t.relative)) for t in (STATE, VOLTAGE))
OUTPUTS = {"observer": ESTIMATE, "controller": COMMAND, "both": (*ESTIMATE, *COMMAND)}
"""Fields of a sample that each of `THROUGH` computes."""

SIGNALS = {c.name: (topic.name, c.field) for topic in LOOP for c in columns_of(topic.relative)}
"""Topic and field of a message where each field of a sample stands."""


class Divergence(NamedTuple):
    """The first value in which two runs differ.

    Attributes
    ----------
    sample : int
        Number of the sample.
    topic, field : str
        Where it stands.
    first, second : float
        Recorded and replayed, or of the one recording and the other.
    """

    sample: int
    topic: str
    field: str
    first: float
    second: float

    def __str__(self) -> str:
        return (
            f"sample {self.sample}, {self.topic} {self.field}: {self.first!r} and {self.second!r}"
        )


@dataclass(frozen=True)
class Replay:
    """What came of it.

    Attributes
    ----------
    through : str
        One of `THROUGH`.
    samples : (n,) array of `SAMPLE`
        As recorded, with what the blocks say now in place of what they said then.
    recorded : (n,) array of `SAMPLE`
        The same samples as recorded.
    changes : int
        Changes of parameters that were applied.
    first : Divergence or None
        The first difference.
    """

    through: str
    samples: np.ndarray
    recorded: np.ndarray
    changes: int
    first: Divergence | None

    @property
    def differences(self) -> dict[str, dict[str, float | str]]:
        """Rms and maximum of the differences of each output, in its unit."""
        told: dict[str, dict[str, float | str]] = {}
        for name in OUTPUTS[self.through]:
            unit, scale = FINE[column_of(name).unit]
            spread = Spread()
            for part in pieces(len(self.samples), self.samples, self.recorded):
                spread.add((self.samples[name][part] - self.recorded[name][part]) * scale)
            told[name] = {"rms": spread.rms, "max": spread.largest, "unit": unit}
        return told


def whole(recording: Recording, path: Path) -> int:
    """Samples from the first on without a gap.

    Raises
    ------
    BagError
        The recording does not begin with the run.
    """
    if recording.first:
        raise BagError(
            f"{path} begins at {recording.first} ns: what the blocks knew by then is not "
            "recorded, so they cannot run again"
        )
    stamps = recording.stamps
    for part in pieces(len(stamps), stamps, before=1):
        steps = np.diff(stamps[part]) != recording.T_ns
        if steps.any():
            return part.start + int(np.argmax(steps)) + 1
    return len(stamps)


def divergence(
    first: np.ndarray, second: np.ndarray, fields: Mapping[str, tuple[str, str]]
) -> Divergence | None:
    """First sample and field in which two runs of equal length differ by a bit."""
    found = None
    for part in pieces(len(first), first, second):
        for name, where in fields.items():
            a, b = (np.ascontiguousarray(s[name][part]).view("<u8") for s in (first, second))
            differs = a != b
            if differs.any():
                k = part.start + int(np.argmax(differs))
                if found is None or k < found.sample:
                    found = Divergence(k, *where, float(first[name][k]), float(second[name][k]))
        if found is not None:
            break
    return found


def followed(schema: Any, params: Any, values: Mapping[str, Any]) -> Any:
    """Parameters of a block after a change as a node tells it; the same where none is its own.

    What another type does not tell stays where both types declare it alike: a node tells every
    value that changes with its type, and one of an older version left the others as they were.

    Raises
    ------
    ParameterError
        It cannot be.
    """
    before = flatten(schema, params)
    old, now = specs(schema, before), specs(schema, {**before, **values})
    own = {name: value for name, value in values.items() if name in now}
    if not own:
        return params
    if own.get("type", before.get("type")) != before.get("type"):
        alike = (n for n in old if n != "type" and n in now and old[n].alike(now[n]))
        own = {**{n: before[n] for n in alike}, **own}
    return changed(schema, params, own)


def retune(block: Any, node: str, values: Mapping[str, Any]) -> bool:
    """Change a block as a node tells; whether there was anything of the block itself.

    Raises
    ------
    ParameterError
        It cannot be.
    """
    params = followed(SCHEMAS[node], block.planned, values)
    if params is block.planned:
        return False
    block.retune(params)
    return True


class _Changes:
    """A block whose parameters change where they changed in the recording.

    Parameters
    ----------
    node : str
    block : Live
    recording : Recording
    without : set of str
        Parameters that keep their value.
    """

    def __init__(self, node: str, block: Live, recording: Recording, without: set[str]) -> None:
        self.node = node
        self.block = block
        self.count = 0
        self._pending: list[tuple[int, dict[str, Any]]] = []
        for event in recording.events:
            if event.node == f"{NAMESPACE}/{node}":
                values = {n: v for n, v in event.asked.items() if n not in without}
                if values:
                    self._pending.append((event.stamp, values))

    def until(self, n: int, T_ns: int) -> int:
        """The first sample that goes by the next change, `n` at most."""
        return min(n, -(-self._pending[0][0] // T_ns)) if self._pending else n

    def apply(self, stamp: int) -> None:
        """Take the changes up to `stamp` (ns)."""
        while self._pending and self._pending[0][0] <= stamp:
            at, values = self._pending.pop(0)
            try:
                self.count += retune(self.block, self.node, values)
            except ParameterError as error:
                raise BagError(f"change of /pea/{self.node} at {at} ns: {error}") from None


def replay(
    recording: Recording,
    experiment: Experiment,
    path: Path,
    through: str = "both",
    without: Mapping[str, set[str]] | None = None,
) -> Replay:
    """Run blocks of a recorded run again.

    Parameters
    ----------
    recording : Recording
    experiment : Experiment
        What ran, or should have.
    path : Path
        Where the recording was read from.
    through : {'both', 'observer', 'controller'}
        Blocks to run; `both` feeds the controller what the observer says now.
    without : mapping of str to set of str, optional
        For each node, parameters whose recorded changes do not count.

    Raises
    ------
    BagError
        The recording does not begin with the run, or its changes of parameters do not fit.
    """
    n = whole(recording, path)
    recorded = recording.samples[:n]
    without = without or {}
    blocks = {
        node: Live(models, experiment.nodes[node].params, experiment.T_s, role)
        for node, models, role in (
            ("observer", observer.MODELS, OBSERVER),
            ("controller", controller.MODELS, LAW),
        )
    }
    said = empty(len(recorded), recorded.dtype)
    for part in pieces(n, said, recorded):
        said[part] = recorded[part]
    count = 0
    if through != "controller":
        changes = _Changes(
            "observer", blocks["observer"], recording, without.get("observer", set())
        )
        _observe(changes, said, recording.T_ns)
        count += changes.count
    if through != "observer":
        changes = _Changes(
            "controller", blocks["controller"], recording, without.get("controller", set())
        )
        after = recording.after if n == len(recording.samples) else np.empty((0, 3))
        m = _control(changes, said, after, recording.T_ns, experiment.T_s)
        said, recorded = said[:m], recorded[:m]
        count += changes.count
    if not len(said):
        raise BagError(f"{path} ends before the controller's preview: nothing can run again")
    first = divergence(recorded, said, {name: SIGNALS[name] for name in OUTPUTS[through]})
    return Replay(through, said, recorded, count, first)


def replay_axes(
    recording: Recording,
    experiment: AnyExperiment,
    path: Path,
    through: str = "both",
    without: Mapping[str, Mapping[str, set[str]]] | None = None,
) -> dict[str, Replay]:
    """Run blocks of each axis again, see `replay`; what does not count is told of each axis."""
    return {
        axis: replay(recording.of(axis), one, path, through, (without or {}).get(axis))
        for axis, one in zip(recording.axes, experiment.each, strict=True)
    }


def first_of(each: Mapping[str, Replay]) -> tuple[str, Divergence] | None:
    """The first difference of all axes, and which axis it is of."""
    found = [(axis, one.first) for axis, one in each.items() if one.first is not None]
    return min(found, key=lambda pair: pair[1].sample) if found else None


def _observe(changes: _Changes, said: np.ndarray, T_ns: int) -> None:
    """Fill in the estimates; compiled, where that is worth it and no change is under way."""
    block = changes.block
    if getattr(block.kind, "NEEDS_VELOCITY", False) and any(
        np.isnan(said["y_dot"][part]).any() for part in pieces(len(said), said)
    ):
        raise BagError("this observer needs the true velocity, which the recording does not have")
    rows = said.view("<f8").reshape(len(said), -1)
    compiles = wanted(len(rows))
    k = 0
    while k < len(rows):
        changes.apply(k * T_ns)
        end = min(changes.until(len(rows), T_ns), k + large.PIECE)
        give_back(said)
        if compiles and block.coming is None:
            block.s = observer_kernel(block.model)(rows[k:end], block.c, block.s)
            last = rows[end - 1].tolist()
            block.signals, block.out = (measurement_of(last),), estimate_of(last)
            k = end
            continue
        for row in rows[k : k + 1 if compiles else end]:
            pack_estimate(row, block.output(measurement_of(row.tolist())))
            block.update()
            k += 1


def _control(changes: _Changes, said: np.ndarray, after: np.ndarray, T_ns: int, T_s: float) -> int:
    """Fill in the commands; returns for how many samples the reference reaches far enough."""
    block = changes.block
    rows = said.view("<f8").reshape(len(said), -1)
    columns = list(place(Reference._fields))
    points = empty((len(rows) + len(after), len(columns)))
    for part in pieces(len(rows), said, points):
        points[part] = rows[part][:, columns]
    points[len(rows) :] = after
    horizon = Horizon(T_s)
    horizon.extend(0, _Points(points))
    compiles = wanted(len(rows))
    k = 0
    while k < len(rows):
        changes.apply(k * T_ns)
        end = min(changes.until(len(rows), T_ns), k + large.PIECE)
        give_back(said)
        give_back(points)
        preview = block.params.preview
        known = min(end, len(points) - math.ceil(preview))
        if compiles and block.coming is None and k < known:
            kernel = law_kernel(block.model)
            block.s = kernel(rows[k:known], points[k:], preview, T_s, block.c, block.s)
            k, last = known, rows[known - 1].tolist()
            horizon.preview = preview
            block.signals = (*horizon.at(k - 1), estimate_of(last))
            block.out = command_of(last)
            continue
        for row in rows[k : k + 1 if compiles else end]:
            try:
                _, u = command(block, horizon, k, estimate_of(row.tolist()))
            except LoopFault:
                return k
            pack_command(row, u)
            block.update()
            k += 1
    return k


class _Points(Sequence[Reference]):
    """Rows of an array as points of a reference."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, i: Any) -> Any:
        return Reference(*self._rows[i].tolist())


def asked(
    sets: Sequence[str],
    others: Mapping[str, str],
    through: str,
    axes: Sequence[str] = (AXIS,),
    axis: str = AXIS,
) -> dict[str, set[str]]:
    """For each node, the parameters that the command line decides, of one of several axes.

    Raises
    ------
    ParameterError
        A parameter of what does not run again.
    """
    runs = RUN[through]
    decided: dict[str, set[str]] = {}
    for node, values in experiments.parse_set(sets).items():
        if not values:
            continue
        if "T_s" in values:
            raise ParameterError("--set T_s: the recording has its own sample period")
        if "axes" in values:
            raise ParameterError("--set axes: the recording has its own axes")
        if node not in runs:
            raise ParameterError(
                f"--set {node}.{next(iter(values))}: replay --through {through} runs "
                f"{' and '.join(runs)} only"
            )
        of_others = tuple(f"{other}." for other in axes if other != axis)
        own = {n: v for n, v in values.items() if not n.startswith(of_others)}
        decided[node] = _decides(node, {n.removeprefix(f"{axis}."): v for n, v in own.items()})
    for node, choice in others.items():
        if node not in runs:
            raise ParameterError(f"--{node}: replay --through {through} runs {runs[0]} only")
        decided[node] = decided.get(node, set()) | _decides(
            node, experiments.exchanged(node, choice)
        )
    return decided


def _decides(node: str, values: Mapping[str, object]) -> set[str]:
    """Names of the parameters whose recorded changes do not count beside `values`."""
    names = {str(name) for name in values}
    if names & {"preset", "type"}:
        kinds: Choice = SCHEMAS[node]  # type: ignore[assignment]
        for kind in kinds.kinds:
            known = specs(kinds, {"type": kind})
            names |= {name for name, spec in known.items() if not spec.common}
    if preset := values.get("preset"):
        names |= config.preset_values(node, str(preset)).keys()
    return names


def draw(path: Path, each: Mapping[str, Replay], experiment: AnyExperiment) -> None:
    """Draw recorded and replayed outputs of each axis, and their differences, as PNG."""
    from pea_lab.plot import plt, save
    from pea_report.figures import Run, legend, line, times

    rows = [(axis, found, name) for axis, found in each.items() for name in OUTPUTS[found.through]]
    plot, axes = plt.subplots(
        len(rows), 2, figsize=(12, 1.5 + 2.5 * len(rows)), squeeze=False, constrained_layout=True
    )
    plot.suptitle(f"{experiment.name}: recorded, and what would have been said (open loop)")
    for (both, difference), (own, found, name) in zip(axes, rows):
        t = times(len(found.samples), experiment.T_s)
        runs = [Run("", t, samples, None, (), {}) for samples in (found.recorded, found.samples)]
        unit, scale = FINE[column_of(name).unit]
        recorded, replayed = (run.signal(name, scale) for run in runs)
        both.plot(*line(runs[0], recorded), label="recorded")
        both.plot(*line(runs[1], replayed), "--", label="replayed")
        unit = unit.replace("um", "µm")
        both.set(ylabel=f"{own}: {name} ({unit})" if len(each) > 1 else f"{name} ({unit})")
        then, now, times_ = found.recorded[name], found.samples[name], scale
        gap = line(runs[1], lambda p, a=now, b=then, c=times_: (a[p] - b[p]) * c)  # type: ignore[misc]
        difference.plot(*gap, linewidth=0.8)
        figure = found.differences[name]["rms"]
        difference.set(ylabel=f"difference ({unit})", title=f"{figure:.4g} {unit} rms")
    legend(axes[0][0])
    for axis in axes[-1]:
        axis.set(xlabel="time (s)")
    save(plot, path)
