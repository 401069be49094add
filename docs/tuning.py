"""Write the tables of docs/tuning.md anew: ``.ci/env python docs/tuning.py [--trials N]``."""

import argparse
import re
from pathlib import Path

from pea_experiment import experiments
from pea_lab import steps, tune

PAGE = Path(__file__).with_name("tuning.md")
EXPERIMENT, DURATION = "fig10_sine_150hz", 0.2
PLANT, OBSERVER = "hysteresis_creep_noise_delay", "extended_state"


def put(name, lines):
    """Replace what stands between the marks of a table."""
    text = "\n".join(lines)
    marks = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
    page, count = marks.subn(lambda m: m[1] + text + m[2], PAGE.read_text(encoding="utf-8"))
    assert count == 1, name
    PAGE.write_text(page, encoding="utf-8")


def table(head, rows):
    """Lines of a table."""
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]


def preset(law):
    """The experiment with a law, on the noisy plant with a delay."""
    others = {"controller": law, "observer": OBSERVER, "plant": PLANT}
    return experiments.load(EXPERIMENT, (), DURATION, None, others)


def compared(trials):
    """Error of presets and tuned gains on each plant."""
    rows = []
    with tune.Processes() as workers:
        for law in ("recommended", "precise"):
            experiment = preset(law)
            goal = tune.Goal(1.3, tune.plants_of(experiment), tune.gains_of(experiment))
            found = tune.tune(experiment, goal, trials, 0, workers, lambda done, best: None)
            text = tune.config.dump(experiment.sections())
            names = tuple(goal.ranges)
            for title, trial in ((f"`{law}`", found[0]), (f"tuned from `{law}`", tune.best(found))):
                candidate = (tuple(trial.values.values()),)
                tasks = [tune.Task(text, sets, names, candidate) for sets in goal.plants.values()]
                scores = [score for (score,) in workers(tasks)]
                gains = ", ".join(
                    f"{name.partition('.')[2]} {value:.3g}" for name, value in trial.values.items()
                )
                rows.append(
                    [
                        title,
                        *(f"{score.error_nm:.2f}" for score in scores),
                        f"**{trial.error_nm:.2f}**",
                        *(tune.margin_text(m) for m in (trial.command, trial.actuator)),
                        gains,
                    ]
                )
    margins = ("margin at the command", "at the actuator")
    return table(["gains", *goal.plants, "all, rms", *margins, ""], rows)


def main():
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=96)
    parser.add_argument("--only", choices=("steps", "presets"))
    arguments = parser.parse_args()
    if arguments.only != "presets":
        head = ["block", "changes", "refused", "largest step by", "step (V)", "after it (V)", "by"]
        put("steps", table(head, steps.table()))
    if arguments.only != "steps":
        put("presets", compared(arguments.trials))


if __name__ == "__main__":
    main()
