"""What `pea tune` leaves behind: presets, a table of the candidates, a summary, a picture."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pea_controller.model.common import ActuatorLimits
from pea_core import config
from pea_core.config import NodeParams
from pea_core.nominal import NominalModel
from pea_core.params import specs
from pea_experiment.experiment import Experiment
from pea_lab.tune import TUNED, Goal, Trial, best, margin_text, varied


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Those that no other one betters in both error and margin, by their error."""
    found: list[Trial] = []
    for trial in sorted(trials, key=lambda trial: (trial.error_nm, -trial.margin)):
        if math.isfinite(trial.error_nm) and (not found or trial.margin > found[-1].margin):
            found.append(trial)
    return found


def preset(experiment: Experiment, node: str) -> dict[str, Any]:
    """Values of a node's preset: its type and gains; model and limits are left to others."""
    followed = {*ActuatorLimits._fields, "delay_samples", "sensor_delay_samples"}
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
