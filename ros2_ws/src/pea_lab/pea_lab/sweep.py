"""Sweeps: an experiment run many times with other values, on all cores, side by side in lanes.

The runs are those of ``pea run --mode batch``, to the bit, without recording: `pea_engine.lanes`
carries the same models through many runs at once.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from pea_controller.model.common import OF_THE_PLANT
from pea_core.axes import previewed
from pea_core.config import NODES
from pea_core.loop import PREVIEW_MAX
from pea_core.params import ParameterError, nearest, specs
from pea_core.signals import UNITS, Reference
from pea_core.step import loop_step
from pea_engine import lanes
from pea_engine.compiled import SWITCH
from pea_engine.kernels import EVERY
from pea_experiment import score
from pea_experiment.experiment import SCHEMAS, AnyExperiment, MultiAxis
from pea_experiment.experiments import load, load_axes, parse_set
from pea_lab import sweep_axes
from pea_lab.settling import unheld
from pea_lab.sweep_groups import (
    Course,
    Group,
    Made,
    Runs,
    plain_number,
    refuse_unheld,
    text_of_value,
)

T = TypeVar("T")

PIECE = 2000
"""Samples of one call of a kernel."""


@dataclass
class Sweep:
    """Results of a sweep: every array has one element for each run.

    Attributes
    ----------
    experiment : str
        Name of the experiment.
    T_s : float
        Sample period (s).
    samples : int
        Length of each run.
    varied : dict of str to (runs,) array
        The values that were given, by name.
    metrics : dict of str to (runs,) array
        As in ``metrics.json``, to rounding; NaN where the run has failed.
    signals : dict of str to (runs, samples) array
        What was kept, in SI units; NaN from where a run has failed.
    failed_at : (runs,) array
        First sample whose command was not finite; -1 where there is none.
    units : dict of str to str
        Unit of every metric, signal and varied parameter.
    """

    experiment: str
    T_s: float
    samples: int
    varied: dict[str, np.ndarray]
    metrics: dict[str, np.ndarray]
    signals: dict[str, np.ndarray]
    failed_at: np.ndarray
    units: dict[str, str] = field(repr=False)

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return len(self.failed_at)

    @property
    def t(self) -> np.ndarray:
        """Loop time of every sample (s)."""
        return np.arange(self.samples) * self.T_s

    def __getitem__(self, name: str) -> np.ndarray:
        """A metric, a signal or a varied parameter by its name."""
        for found in (self.metrics, self.signals, self.varied):
            if name in found:
                return found[name]
        raise KeyError(f"{name}: {nearest(name, self.units)}")

    def frame(self) -> Any:
        """Varied parameters and metrics as a pandas DataFrame, one row a run."""
        import pandas as pd

        return pd.DataFrame({**self.varied, **self.metrics, "failed_at": self.failed_at})


def simulate(
    experiment: str,
    vary: Mapping[str, object] | None = None,
    *,
    runs: int | None = None,
    sets: Sequence[str] = (),
    duration: float | None = None,
    keep: Sequence[str] = (),
    threads: int | None = None,
    progress: bool = True,
    force: bool = False,
) -> Sweep:
    """Run an experiment many times, with other plants, seeds or gains each time.

    All cores work, each on `pea_engine.lanes.LANES` runs side by side; of several axes each on one
    run (`pea_lab.sweep_axes`). Metrics and signals of the axis x are then ``x.NAME``, beside those
    of the whole stage. A run is bit-identical to
    ``pea run EXPERIMENT --mode batch`` with the same values; nothing is recorded.

    Parameters
    ----------
    experiment : str
        Name, or path of a YAML file, as for ``pea run``.
    vary : mapping of str to array
        Names as for ``--set`` (``plant.K``, ``plant.seed``, ``controller.P``), and a value for
        each run; a single value counts for all runs. ``T_s`` and the duration cannot vary.
    runs : int, optional
        Number of runs; needed only where nothing in `vary` has a value for each.
    sets : sequence of str
        ``NODE.PARAM=VALUE``, for all runs.
    duration : float, optional
        Loop time of each run (s); else the experiment's own.
    keep : sequence of str
        Signals of which every sample is kept, of every axis (`UNITS`): w w_dot w_ddot y y_dot
        u_applied x1_hat x2_hat eps_hat u, and the truth x1 x2 eps. The metrics are always there.
    threads : int, optional
        Threads that compute; else as many as this process has cores.
    progress : bool
        Whether a bar on standard error shows how far it is.
    force : bool
        Whether a law that does not hold a raw step through a slew limit is run all the same.
        Otherwise such a run is refused; the check takes half a second a run.

    Returns
    -------
    Sweep

    Raises
    ------
    ParameterError
        Anything unknown, out of range, or that does not go together; the run is named.

    Examples
    --------
    >>> s = simulate("fig9_hysteresis_10hz", {"plant.K": [0.13, 0.14, 0.15]}, progress=False)
    >>> s["rms_error_nm"].shape
    (3,)
    """
    given = _columns(vary or {}, runs)
    count = len(next(iter(given.values()))) if given else runs or 1
    for name in keep:
        if name not in UNITS:
            raise ParameterError(f"keep: unknown signal {name!r}: {nearest(name, UNITS)}")
    cores = threads or len(os.sched_getaffinity(0))
    if cores < 1:
        raise ParameterError(f"threads = {cores}: must be at least 1")
    _check_names(given, sets)
    with _naming(0, given):
        first = load_axes(experiment, [*sets, *_typed(given, 0)], duration)
    with _shown(progress, count) as advance:
        if isinstance(first, MultiAxis):
            each = _each_of_axes(experiment, sets, duration, given, count, force)
            return _of_axes(each, given, keep, cores, advance)
        groups = _groups(experiment, sets, duration, given, count, force)
        sample = groups[0].base
        units = {**score.UNITS, **{name: UNITS[name] for name in keep}, **_units(sample, given)}
        result = _empty(sample, given, count, score.UNITS, keep, units)
        carry = _plainly if os.environ.get(SWITCH) == "0" else _in_lanes
        jobs = [
            (group, group.runs[i : i + lanes.LANES])
            for group in groups
            for i in range(0, len(group.runs), lanes.LANES)
        ]
        done = _on_all_cores(cores, [partial(carry, *job, result) for job in jobs])
        for (_, some), _ in zip(jobs, done, strict=True):
            advance(len(some))
    return result


def _empty(
    sample: AnyExperiment,
    given: Mapping[str, list[object]],
    count: int,
    figures: Iterable[str],
    keep: Iterable[str],
    units: dict[str, str],
) -> Sweep:
    """A sweep whose results are not computed yet."""
    return Sweep(
        sample.name,
        sample.T_s,
        sample.samples,
        {name: np.array(values) for name, values in given.items()},
        {name: np.full(count, np.nan) for name in figures},
        {name: np.full((count, sample.samples), np.nan) for name in keep},
        np.full(count, -1),
        units,
    )


def _on_all_cores(cores: int, jobs: Sequence[Callable[[], T]]) -> Iterator[T]:
    """Results of the jobs in their order; after a failure no further job begins."""
    with ThreadPoolExecutor(cores) as pool:
        told = [pool.submit(job) for job in jobs]
        try:
            for future in told:
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _typed(given: Mapping[str, list[Any]], run: int) -> list[str]:
    """The values of a run, as after ``--set``."""
    return [f"{name}={text_of_value(values[run])}" for name, values in given.items()]


def _each_of_axes(
    experiment: str,
    sets: Sequence[str],
    duration: float | None,
    given: Mapping[str, list[object]],
    count: int,
    force: bool,
) -> list[MultiAxis]:
    """The runs of an experiment of several axes, checked."""
    each: list[MultiAxis] = []
    for run in range(count):
        with _naming(run, given):
            loaded = load_axes(experiment, [*sets, *_typed(given, run)], duration)
            if not isinstance(loaded, MultiAxis) or (each and loaded.axes != each[0].axes):
                raise ParameterError("axes: are the same of all runs; sweep one number of axes")
            if any(one.nodes["controller"].params.inject.where != "off" for one in loaded.each):
                raise ParameterError("controller.inject.where: a sweep injects nothing")
            for one in () if force else loaded.each:
                refuse_unheld(one, unheld(one))
            each.append(loaded)
    return each


def _of_axes(
    each: Sequence[MultiAxis],
    given: Mapping[str, list[object]],
    keep: Sequence[str],
    cores: int,
    advance: Callable[[int], None],
) -> Sweep:
    """The sweep of an experiment of several axes; results of one axis are named ``x.NAME``."""
    axes, count = each[0].axes, len(each)
    own = {**score.UNITS, **{name: UNITS[name] for name in keep}}
    units = dict(score.UNITS) | {f"{axis}.{name}": own[name] for axis in axes for name in own}
    units |= _units(each[0], given)
    figures = [*score.UNITS, *sweep_axes.names(axes, tuple(score.UNITS))]
    result = _empty(each[0], given, count, figures, sweep_axes.names(axes, keep), units)
    jobs = [partial(sweep_axes.run, one, keep) for one in each]
    for run, found in enumerate(_on_all_cores(cores, jobs)):
        for name, value in found.figures.items():
            result.metrics[name][run] = value
        for name, kept in found.signals.items():
            result.signals[name][run] = kept
        result.failed_at[run] = found.failed_at
        advance(1)
    return result


def _columns(vary: Mapping[str, Any], runs: int | None) -> dict[str, list[Any]]:
    """The value of each name in each run."""
    given = {
        name: values.tolist() if isinstance(values, np.ndarray | np.generic) else values
        for name, values in vary.items()
    }
    single = {name for name, values in given.items() if isinstance(values, str | Real)}
    columns = {name: list(values) for name, values in given.items() if name not in single}
    lengths = {name: len(values) for name, values in columns.items()}
    if runs is not None:
        lengths["runs"] = runs
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} has {n}" for name, n in lengths.items())
        raise ParameterError(f"vary: {told}: give as many values of each")
    count = next(iter(lengths.values()), 1)
    if count < 1:
        raise ParameterError("vary: there is no run; give one value of each at least")
    return {name: columns.get(name) or [given[name]] * count for name in vary}


def _check_names(given: Mapping[str, list[object]], sets: Sequence[str]) -> None:
    """Refuse names that cannot vary, or that are given twice.

    Raises
    ------
    ParameterError
        One of them.
    """
    for name in given:
        node, _, rest = name.partition(".")
        if node not in NODES or not rest or rest == "T_s":
            raise ParameterError(
                f"vary: {name!r} cannot vary: write NODE.PARAM, NODE one of {', '.join(NODES)}"
            )
    fixed = {f"{node}.{rest}" for node, values in parse_set(sets).items() for rest in values}
    if both := sorted(fixed & given.keys()):
        raise ParameterError(f"vary {both[0]} and sets {both[0]}: give one of them")


@contextlib.contextmanager
def _naming(run: int, given: Mapping[str, list[object]]) -> Iterator[None]:
    """Add the number of the run to an error."""
    try:
        yield
    except ParameterError as error:
        if not given or len(next(iter(given.values()))) == 1:
            raise
        raise ParameterError(f"run {run}: {error}") from None


def _groups(
    experiment: str,
    sets: Sequence[str],
    duration: float | None,
    given: Mapping[str, list[object]],
    count: int,
    force: bool,
) -> list[Group]:
    """Every run, designed and checked, with those that one kernel can take."""
    followed = {f"plant.{name}" for name in OF_THE_PLANT}
    # values that choose a model, or that other nodes follow, make an experiment of their own
    chosen = [
        name
        for name, values in given.items()
        if name in followed or not all(plain_number(value) for value in values)
    ]
    bases: dict[Any, Runs] = {}
    groups: dict[Any, Group] = {}
    varying = {name.partition(".")[0] for name in given if name not in chosen}
    for run in range(count):
        with _naming(run, given):
            choice = tuple(repr(given[name][run]) for name in chosen)
            if choice not in bases:
                more = [f"{n}={text_of_value(given[n][run])}" for n in chosen]
                bases[choice] = Runs(load(experiment, [*sets, *more], duration))
            of = bases[choice]
            changes: dict[str, dict[str, Any]] = {node: {} for node in NODES}
            for name, values in given.items():
                if name not in chosen:
                    node, _, rest = name.partition(".")
                    changes[node][rest] = values[run]
            params = {node: of.params(node, changes[node]) for node in NODES}
            blocks = {node: of.made(node, params[node]) for node in NODES[:3]}
            course = of.course(params["reference"])
            of.check(params["plant"], params["controller"], course)
            if not force:
                of.held(params)
        preview = params["controller"].preview
        c = tuple(block[1] for block in blocks.values())
        models = tuple(id(block[0]) for block in blocks.values())
        key = id(of), models, lanes.kind(c), preview
        if key not in groups:
            groups[key] = Group(
                of.base,
                {node: block[0] for node, block in blocks.items()},
                preview,
                of.course,
                "reference" in varying,
            )
        groups[key].runs.append(run)
        groups[key].made[run] = {
            **{node: Made(params[node], blocks[node][1]) for node in NODES[:3]},
            "reference": Made(params["reference"], None),
        }
    return list(groups.values())


def _units(sample: AnyExperiment, given: Mapping[str, object]) -> dict[str, str]:
    """Unit of each varied parameter, of all axes or of one."""
    found = {}
    for name in given:
        node, _, rest = name.partition(".")
        for axis, one in zip(sample.axes, sample.each, strict=True):
            own = rest.removeprefix(f"{axis}.") if len(sample.axes) > 1 else rest
            known = specs(SCHEMAS[node], one.nodes[node].values)
            if own in known:
                found[name] = known[own].unit
        found.setdefault(name, "")
    return found


@contextlib.contextmanager
def _shown(progress: bool, count: int) -> Iterator[Callable[[int], None]]:
    """A bar of the runs that are done; the first of them waits for the compiler."""
    if not progress:
        yield lambda runs: None
        return
    from pea_core.console import bar, err

    with bar(err) as shown:
        task = shown.add_task("compiling (once for these blocks)", total=count)
        yield lambda runs: shown.update(task, advance=runs, description="runs")


def _in_lanes(group: Group, runs: Sequence[int], result: Sweep) -> None:
    """Carry up to `lanes.LANES` runs through."""
    columns = [*runs, *[runs[-1]] * (lanes.LANES - len(runs))]
    c = [group.coefficients(run) for run in columns]
    states = [group.states(each) for each in c]  # keeps the long arrays that the blocks point at
    of_c, of_s = lanes.blocks(c, True), lanes.blocks(states)
    courses = [group.courses(group.made[run]["reference"].params) for run in columns]
    if not group.each:
        courses = courses[:1]
    sources = [group.noise(run) for run in runs]
    bad = np.full(lanes.LANES, result.samples)
    noise = np.zeros((PIECE, lanes.LANES))
    rows = np.empty((PIECE if result.signals else 1, len(lanes.SIGNALS), lanes.LANES))
    kernel = group.kernel(bool(result.signals))
    ahead = int(group.preview)
    for k in range(0, result.samples, PIECE):
        n = min(PIECE, result.samples - k)
        for lane, source in enumerate(sources):
            if source is not None:
                noise[:n, lane] = source.take(n)
        points = np.stack([w.points[k : k + n + PREVIEW_MAX + 1] for w in courses], axis=2)
        counts = np.stack([w.counts[k : k + n] for w in courses], axis=1)
        kernel(
            *(*group.like, *of_c, *of_s, bad, k, points, ahead, group.preview - ahead),
            *(group.base.T_s, noise[:n], counts, rows),
        )
        for name, kept in result.signals.items():
            kept[runs, k : k + n] = rows[:n, lanes.SIGNALS.index(name), : len(runs)].T
    before = lanes.numbers(states[0][:3])
    of_score = lanes.Blocks(
        of_s.floats[len(before.floats) :], of_s.integers[len(before.integers) :]
    )
    for lane, run in enumerate(runs):
        counted = lanes.state(states[lane][3], lane, of_score)
        _tell(result, run, counted, courses[lane if group.each else 0], int(bad[lane]))


def _plainly(group: Group, runs: Sequence[int], result: Sweep) -> None:
    """The same in plain Python, for debugging: ``PEA_COMPILE=0``."""
    compute, commit = loop_step(*(group.models[node] for node in NODES[:3]))
    truth = group.models["plant"].truth
    ahead = int(group.preview)
    for run in runs:
        *c, m = group.coefficients(run)
        *s, s_m = group.states((*c, m))
        course = group.courses(group.made[run]["reference"].params)
        source = group.noise(run)
        bad = result.samples
        for k in range(result.samples):
            noise = next(source) if source else 0.0
            W = Reference(*course.points[k].tolist())
            W_ff = previewed(course.points, k, EVERY, ahead, group.preview - ahead, group.base.T_s)
            measured, estimate, u = compute(c, s, noise, W, W_ff)
            if not math.isfinite(u):
                bad, u = min(bad, k), 0.0
            true = truth(c[0], s[0])
            s_m = score.update(m, s_m, bool(course.counts[k]), W, true, measured, estimate, u)
            eps = score.lumped(m, true, measured.u_applied)
            told = (*W, *measured, *estimate, u, true.x1, true.x2, eps)
            for name, kept in result.signals.items():
                kept[run, k] = told[lanes.SIGNALS.index(name)]
            s = commit(c, s, noise, W, W_ff, measured, estimate, u)
        _tell(result, run, s_m, course, bad)


def _tell(result: Sweep, run: int, counted: score.State, course: Course, bad: int) -> None:
    """Store the results of a run."""
    if bad < result.samples:
        result.failed_at[run] = bad
        for kept in result.signals.values():
            kept[run, bad:] = np.nan
        return
    for name, value in score.figures(counted, course.amplitude).items():
        result.metrics[name][run] = value
