"""Gains for a stated goal: least error over a set of plants, with a gain margin on each of them.

Optuna's tree of Parzen estimators proposes `GENERATION` candidates at a time; each of them runs on
every plant, as in batch mode; their figures are told back in their order. What is proposed then
rests on the seed and on figures that are the same on every machine, never on which worker was
faster or how many there are: the result is the same with one process, with eight, and on a Dask
cluster.

The first candidate is what the experiment has: nothing worse ever comes out.
"""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
import os
import signal
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_controller.model.common import CommonParams, Limits
from pea_core import config
from pea_core.config import NodeParams
from pea_core.nominal import NominalModel
from pea_core.params import ParameterError, build, flatten, nearest, specs
from pea_experiment import experiments
from pea_experiment.experiments import SCHEMAS, Experiment
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


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Those that no other one betters in both error and margin, by their error."""
    found: list[Trial] = []
    for trial in sorted(trials, key=lambda trial: (trial.error_nm, -trial.margin)):
        if math.isfinite(trial.error_nm) and (not found or trial.margin > found[-1].margin):
            found.append(trial)
    return found


def margin_text(margin: float) -> str:
    """A gain margin for people."""
    if math.isnan(margin):
        return "nonlinear"
    return f"{margin:.3g}" if margin < MARGINS else f"above {MARGINS:g}"


def preset(experiment: Experiment, node: str) -> dict[str, Any]:
    """Values of a node's preset: its type and gains; model and limits are left to others."""
    followed = {*Limits._fields, "delay_samples", "sensor_delay_samples"}
    left = {*specs(NodeParams), *specs(NominalModel), *followed}
    return {
        name: value
        for name, value in experiment.nodes[node].values.items()
        if name not in left and not name.startswith("tuning.")
    }


def write(
    out: Path, experiment: Experiment, goal: Goal, trials: Sequence[Trial], seed: int
) -> None:
    """Write presets, ``trials.csv``, ``tune.json`` and ``tune.png`` into a directory."""
    found, first = best(trials), trials[0]
    tuned = varied(experiment, found.values)
    about = (
        f"# Found by pea tune {experiment.name}: {found.error_nm:.4g} nm rms over "
        f"{len(goal.plants)} plants (before: {first.error_nm:.4g}),\n"
        f"# gain margin {margin_text(found.margin)} (at least {goal.margin:g}): at the command "
        f"{margin_text(found.command)}, at the actuator {margin_text(found.actuator)}; "
        f"{len(trials)} trials, seed {seed}.\n"
    )
    # nothing to load where no candidate keeps the margin
    for node in {name.partition(".")[0] for name in goal.ranges} if found.good else ():
        text = about + config.dump({node: preset(tuned, node)})
        (out / f"{node}.yaml").write_text(text, encoding="utf-8")
    with (out / "trials.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*goal.ranges, *Trial._fields[1:]])
        table.writerows([*trial.values.values(), *trial[1:]] for trial in trials)
    (out / "tune.json").write_text(
        json.dumps(summary(experiment, goal, trials, seed), indent=2) + "\n", encoding="utf-8"
    )
    draw(out / "tune.png", experiment, goal, trials)


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


def gather(there: Path, axes: Sequence[str]) -> list[str]:
    """Put the presets that lie in a directory of each axis into files of all axes; their names."""
    written = []
    for node in TUNED:
        own = {axis: there / axis / f"{node}.yaml" for axis in axes}
        values: dict[str, Any] = {}
        for axis, path in own.items():
            if path.exists():
                found = config.read(path, (node,))[node]
                values |= {f"{axis}.{name}": value for name, value in found.items()}
        if values:
            written.append(f"{node}.yaml")
            (there / written[-1]).write_text(config.dump({node: values}), encoding="utf-8")
    return written


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


def summary(
    experiment: Experiment, goal: Goal, trials: Sequence[Trial], seed: int
) -> dict[str, Any]:
    """What came of it, as printed by ``pea tune --json``."""
    found = best(trials)

    def told(trial: Trial) -> dict[str, Any]:
        return {
            key: None if isinstance(value, float) and not math.isfinite(value) else value
            for key, value in trial._asdict().items()
        }

    return {
        "experiment": experiment.name,
        "seed": seed,
        "trials": len(trials),
        "least_margin": goal.margin,
        "plants": list(goal.plants),
        "before": told(trials[0]),
        "best": told(found),
    }


def draw(path: Path, experiment: Experiment, goal: Goal, trials: Sequence[Trial]) -> None:
    """Draw what was traded: error against margin, and against the steps of the voltage."""
    from pea_lab.plot import plt, save

    plot, axes = plt.subplots(1, 2, figsize=(12, 5), sharey=True, constrained_layout=True)
    plot.suptitle(f"{experiment.name}: {len(trials)} candidates over {len(goal.plants)} plants")
    ran = [trial for trial in trials if math.isfinite(trial.error_nm)]
    marks = [("best", best(trials), "o"), ("before", trials[0], "s")]
    marks = [mark for mark in marks if mark[1] in ran]  # an unstable one has no error
    scale = "log" if any(trial.error_nm > 0.0 for trial in ran) else "linear"
    for axis, name in zip(axes, ("margin", "step_V"), strict=True):
        axis.scatter(
            [getattr(trial, name) for trial in ran],
            [trial.error_nm for trial in ran],
            s=14,
            c=["C0" if trial.good else "0.7" for trial in ran],
        )
        for label, trial, mark in marks:
            axis.plot(getattr(trial, name), trial.error_nm, mark, ms=9, mfc="none", label=label)
    edge = front(ran)
    axes[0].step([t.margin for t in edge], [t.error_nm for t in edge], "C1", lw=1, where="post")
    axes[0].axvline(goal.margin, color="C3", ls=":", label="least margin")
    axes[0].set(xlabel="least gain margin", ylabel="error (nm, rms over the plants)", yscale=scale)
    axes[1].set(
        xlabel="rms step of the voltage (V)",
        xscale="log" if any(trial.step_V > 0.0 for trial in ran) else "linear",
    )
    axes[0].legend()
    save(plot, path)
