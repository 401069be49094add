"""Gains for a stated goal: least error over a set of plants, with a gain margin on each of them.

Optuna's tree of Parzen estimators proposes `GENERATION` candidates at a time; each of them runs on
every plant, as in batch mode; their figures are told back in their order. What is proposed then
rests on the seed and on figures that are the same on every machine, never on which worker was
faster or how many there are: the result is the same with one process, with eight, and on a Dask
cluster.

The first candidate is what the experiment has: nothing worse ever comes out.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model.common import CommonParams
from pea_core import config
from pea_core.params import ParameterError, build, flatten, nearest, specs
from pea_experiment import experiments
from pea_experiment.experiment import SCHEMAS, Experiment
from pea_lab.guard import BOUNDLESS, altered, margins
from pea_lab.settling import oscillation
from pea_plant.model import hysteresis

GENERATION = 16
"""Candidates that are proposed together: so many workers can be busy, whatever their number."""

SPREAD = 8.0
"""A gain is looked for from 1/8 to 8 times what it is, where no range is given."""

MARGINS = 4.0
"""Margins are looked for up to so much."""

TOO_LITTLE = 1e6
"""What a candidate without the margin counts as (nm), and more the less it has."""

TUNED = ("controller", "observer")


class Goal(NamedTuple):
    """What is wanted.

    Attributes
    ----------
    margin : float
        Least gain margin on every plant.
    plants : dict of str to tuple of str
        Settings ``plant.NAME=VALUE`` of each plant, by a name for people.
    ranges : dict of str to (low, high)
        What may be varied, ``controller.NAME`` or ``observer.NAME``.
    """

    margin: float
    plants: dict[str, tuple[str, ...]]
    ranges: dict[str, tuple[float, float]]


class Task(NamedTuple):
    """Candidates on one plant: what a worker gets; nothing of it is on the worker's disk.

    Attributes
    ----------
    text : str
        The experiment as a parameter file.
    sets : tuple of str
        Settings of the plant.
    names : tuple of str
        What is varied.
    candidates : tuple of tuple of float
        Values, in the order of `names`.
    """

    text: str
    sets: tuple[str, ...]
    names: tuple[str, ...]
    candidates: tuple[tuple[float, ...], ...]


class Score(NamedTuple):
    """One candidate on one plant: error (nm), step of the voltage (V), both rms, and gain margins.

    Without a margin the loop is unstable, and nothing is run; NaN where a law has none. See
    `check` for the margins: that at the command, that at the actuator, and the smaller of both.
    """

    error_nm: float
    step_V: float
    margin: float
    command: float
    actuator: float


class Trial(NamedTuple):
    """One candidate on all plants.

    Attributes
    ----------
    values : dict of str to float
    error_nm, step_V : float
        Root of the mean square over the plants.
    worst_nm : float
        Largest error of a plant (nm, rms).
    margin, command, actuator : float
        Least of all plants: gain margin, that at the command, that at the actuator.
    good : bool
        Whether the margin is kept, and the loop comes to rest after raw steps (`settling`).
    """

    values: dict[str, float]
    error_nm: float
    step_V: float
    worst_nm: float
    margin: float
    command: float
    actuator: float
    good: bool


@cache
def _file(text: str) -> str:
    """Path of a file that holds `text`, for as long as this process lives."""
    file = tempfile.NamedTemporaryFile(  # noqa: SIM115
        "w", prefix="pea-tune-", suffix=".yaml", encoding="utf-8"
    )
    file.write(text)
    file.flush()
    _files.append(file)
    return file.name


_files: list[Any] = []


def varied(experiment: Experiment, values: Mapping[str, float]) -> Experiment:
    """The experiment with other values of ``NODE.NAME``.

    Raises
    ------
    ParameterError
        They are out of range, or do not go together.
    """
    changes = {}
    for node in TUNED:
        own = {n.partition(".")[2]: v for n, v in values.items() if n.startswith(f"{node}.")}
        if own:
            flat = flatten(SCHEMAS[node], experiment.nodes[node].params)
            changes[node] = build(SCHEMAS[node], {**flat, **own}, f"{node}.")
    return altered(experiment, changes)


def _margin(experiment: Experiment, values: Mapping[str, float]) -> tuple[float, float, float]:
    """Gain margins of a candidate; 1 at most where the guard would refuse its delay margin."""
    try:
        there = varied(experiment, values)
        found = margins(there, MARGINS)
    except ParameterError:  # cannot be designed on this plant
        return 0.0, 0.0, 0.0
    if found == BOUNDLESS:
        return math.nan, math.nan, math.nan
    late = found.delay < there.nodes["controller"].params.tuning.delay_margin
    most = 1.0 if late else math.inf
    return min(found.gain, most), min(found.command, most), min(found.actuator, most)


def evaluate(task: Task) -> list[Score]:
    """Run candidates on one plant."""
    from pea_lab.sweep import simulate

    path = _file(task.text)
    experiment = experiments.load(path, task.sets)
    known = [_margin(experiment, dict(zip(task.names, c, strict=True))) for c in task.candidates]
    runs = [i for i, found in enumerate(known) if not found[0] <= 1.0]
    scores = [Score(math.inf, math.inf, *found) for found in known]
    if runs:
        columns = zip(*(task.candidates[i] for i in runs), strict=True)
        vary = {name: list(column) for name, column in zip(task.names, columns, strict=True)}
        sweep = simulate(path, vary, sets=task.sets, threads=1, progress=False)
        for place, i in enumerate(runs):
            error, step = sweep["rms_error_nm"][place], sweep["rms_voltage_step_V"][place]
            if math.isfinite(error):
                scores[i] = Score(float(error), float(step), *known[i])
    return scores


Workers = Callable[[Sequence[Task]], Iterable[list[Score]]]
"""Evaluates tasks, and gives the answers in their order."""


class Processes:
    """Workers that are processes of this machine.

    Parameters
    ----------
    count : int, optional
        How many; as many as there are cores where not given.
    """

    def __init__(self, count: int | None = None) -> None:
        self._pool = ProcessPoolExecutor(
            count or len(os.sched_getaffinity(0)),
            multiprocessing.get_context("spawn"),
            initializer=signal.signal,
            initargs=(signal.SIGINT, signal.SIG_DFL),
        )

    def __enter__(self) -> Workers:
        return lambda tasks: self._pool.map(evaluate, tasks)

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


class Cluster:
    """Workers of a Dask cluster; each needs this project installed.

    Parameters
    ----------
    address : str
        Of its scheduler, ``tcp://127.0.0.1:8786``. It can run any code in this process.
    security : distributed.Security, optional
        Certificates, for an address ``tls://HOST:PORT``.

    Raises
    ------
    ParameterError
        It is no address.
    OSError
        Nobody answers there.
    """

    def __init__(self, address: str, security: object = None) -> None:
        from distributed import Client

        make: Any = Client
        try:
            self._client = make(address, timeout="10s", security=security)
        except ValueError as error:
            raise ParameterError(
                f"--scheduler {address!r}: {error}; write tcp://HOST:PORT"
            ) from None

    def __enter__(self) -> Workers:
        client = self._client

        def spread(tasks: Sequence[Task]) -> Iterable[list[Score]]:
            found: list[list[Score]] = client.gather(client.map(evaluate, tasks, pure=False))
            return found

        return spread

    def __exit__(self, *_: object) -> None:
        self._client.close()


def plants_of(experiment: Experiment) -> dict[str, tuple[str, ...]]:
    """The plant as given, with K and omega_n 10 % off, and with every other hysteresis model."""
    values = experiment.nodes["plant"].values
    found: dict[str, tuple[str, ...]] = {"as given": ()}
    for name in ("K", "omega_n"):
        for percent in (-10, 10):
            value = float(values[name]) * (1.0 + percent / 100.0)  # type: ignore[arg-type]
            found[f"{name} {percent:+d} %"] = (f"plant.{name}={value!r}",)
    for kind in hysteresis.PRESENT:
        if kind != values["hysteresis.type"]:
            found[f"hysteresis {kind}"] = (f"plant.hysteresis.type={kind}",)
    return found


def gains_of(experiment: Experiment) -> dict[str, tuple[float, float]]:
    """The gains of the law, each from 1/`SPREAD` to `SPREAD` times what it is."""
    node = experiment.nodes["controller"]
    shared = specs(CommonParams)
    found = {}
    for name, spec in specs(type(node.params)).items():
        value = getattr(node.params, name, None) if "." not in name else None
        if name in shared or spec.fixed or not isinstance(value, float) or value <= 0.0:
            continue
        found[f"controller.{name}"] = within(spec, value / SPREAD, value * SPREAD)
    return found


def within(spec: Any, low: float, high: float) -> tuple[float, float]:
    """A range, as far as a parameter allows it."""
    least = -math.inf if spec.low is None else spec.low
    most = math.inf if spec.high is None else spec.high
    return max(low, least), min(high, most)


def range_of(experiment: Experiment, text: str) -> tuple[str, tuple[float, float]]:
    """Name and range of ``NODE.NAME=LOW:HIGH``.

    Raises
    ------
    ParameterError
        Not of that form, unknown, or out of range.
    """
    name, equals, span = text.partition("=")
    node, _, own = name.partition(".")
    ends = span.split(":")
    if not equals or len(ends) != 2:
        raise ParameterError(f"--vary {text!r}: write NODE.NAME=LOW:HIGH")
    if node not in TUNED:
        raise ParameterError(f"--vary {text!r}: unknown node {node!r}: {nearest(node, TUNED)}")
    known = specs(SCHEMAS[node], flatten(SCHEMAS[node], experiment.nodes[node].params))
    if own not in known:
        raise ParameterError(f"--vary {name}: unknown: {nearest(own, known, f'{node}.')}")
    if known[own].kind is not float:
        raise ParameterError(f"--vary {name}: is no real number: give it with --set")
    low, high = (known[own].check(name, end) for end in ends)
    assert isinstance(low, float)
    assert isinstance(high, float)
    if not low < high:
        raise ParameterError(f"--vary {text!r}: {low:g} must be below {high:g}")
    return name, (low, high)


def tune(
    experiment: Experiment,
    goal: Goal,
    trials: int,
    seed: int,
    workers: Workers,
    progress: Callable[[int, Trial], None],
) -> list[Trial]:
    """Look for gains.

    Parameters
    ----------
    experiment : Experiment
    goal : Goal
    trials : int
        Candidates to try.
    seed : int
        Of what is proposed.
    workers : callable
        From `Processes` or `Cluster`.
    progress : callable
        Told how many are done, and the best so far.

    Returns
    -------
    list of Trial
        All, in their order; the first is what the experiment has.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed))
    spans: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(low, high, log=low > 0.0)
        for name, (low, high) in goal.ranges.items()
    }
    names = tuple(goal.ranges)
    study.enqueue_trial(_clipped(_now(experiment, names), goal.ranges))
    text = config.dump(experiment.sections())
    done: list[Trial] = []
    while len(done) < trials:
        asked = [study.ask(spans) for _ in range(min(GENERATION, trials - len(done)))]
        candidates = tuple(tuple(trial.params[name] for name in names) for trial in asked)
        tasks = [Task(text, sets, names, candidates) for sets in goal.plants.values()]
        by_plant = list(workers(tasks))
        for i, trial in enumerate(asked):
            found = summed(dict(trial.params), [scores[i] for scores in by_plant], goal.margin)
            study.tell(trial, found.error_nm if found.good else _penalty(found, goal.margin))
            done.append(found)
        progress(len(done), best(done))
    return settled(experiment, goal, done)


def settled(experiment: Experiment, goal: Goal, trials: Sequence[Trial]) -> list[Trial]:
    """The trials, the best of them one that comes to rest after raw steps on every plant."""
    path, found = _file(config.dump(experiment.sections())), list(trials)
    there = [experiments.load(path, sets) for sets in goal.plants.values()]
    while (now := best(found)).good:
        if not any(oscillation(varied(plant, now.values)) for plant in there):
            break
        found = [t._replace(good=False) if t.values == now.values else t for t in found]
    return found


def _now(experiment: Experiment, names: Sequence[str]) -> dict[str, float]:
    values = {
        f"{node}.{name}": value
        for node in TUNED
        for name, value in experiment.nodes[node].values.items()
    }
    return {name: float(values[name]) for name in names}  # type: ignore[arg-type]


def _clipped(
    values: Mapping[str, float], ranges: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    return {
        name: min(max(value, ranges[name][0]), ranges[name][1]) for name, value in values.items()
    }


def _penalty(trial: Trial, least: float) -> float:
    found = trial.margin if trial.margin < least else 0.0
    return TOO_LITTLE * (1.0 + least - found)


def summed(values: dict[str, float], scores: Sequence[Score], least: float) -> Trial:
    """One candidate's scores on all plants, as one."""
    errors, steps, *margins = (np.array(column) for column in zip(*scores, strict=True))
    smallest, command, actuator = (
        math.nan if np.isnan(each).all() else float(np.nanmin(each)) for each in margins
    )
    error = float(np.sqrt(np.mean(errors**2)))
    good = math.isfinite(error) and not smallest < least
    step = float(np.sqrt(np.mean(steps**2)))
    return Trial(values, error, step, float(errors.max()), smallest, command, actuator, good)


def best(trials: Sequence[Trial]) -> Trial:
    """The least error among those with the margin; where none has it, the largest margin."""
    good = [trial for trial in trials if trial.good]
    if good:
        return min(good, key=lambda trial: trial.error_nm)
    return max(trials, key=lambda trial: trial.margin)


def margin_text(margin: float) -> str:
    """A gain margin for people."""
    if math.isnan(margin):
        return "nonlinear"
    return f"{margin:.3g}" if margin < MARGINS else f"above {MARGINS:g}"


def of_axis(axes: Sequence[str], axis: str, texts: Sequence[str]) -> list[str]:
    """Of ranges as in `range_of` those of an axis: ``NODE.NAME`` is for all, ``NODE.y.NAME`` y."""
    found = []
    for text in texts:
        node, _, rest = text.partition(".")
        first, dot, own = rest.partition(".")
        if not dot or first not in axes:
            found.append(text)
        elif first == axis:
            found.append(f"{node}.{own}")
    return found


def too_close(figures: Mapping[str, Any], least: float | None) -> str:
    """What `pea_lab.coupled.check_axes` finds wrong with a coupled loop; nothing if it is good."""
    if not figures["linear"]:
        return ""
    if not figures["stable"]:
        return f"the coupled loop is unstable (largest pole {figures['largest_pole']:.4g})"
    for axis, own in figures["axes"].items():
        margin = own["gain_margin"]
        if least is not None and margin is not None and margin < least:
            return f"the coupled loop has a gain margin of {margin:.3g} < {least:g} on {axis}"
    return ""
