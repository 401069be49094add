"""``pea commission``: measure a stage, identify it, propose gains, check, ask, run, report.

Exit status: 0 done, 2 bad input (one line, nothing moved), 3 a run failed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from rich.table import Table

from pea_cli import measure
from pea_cli.accept import agreed, work_in
from pea_cli.options import number, whole
from pea_core.console import bar, err, out
from pea_core.params import ParameterError, nearest

STEPS = ("measure", "identify", "propose", "check", "run", "report")


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    commissions = commands.add_parser("commission", help="from an unknown stage to a checked loop")
    measure.common(commissions)
    commissions.add_argument("--step", metavar="NAME", help=f"only {', '.join(STEPS)}")
    commissions.add_argument("--amplitude", metavar="V", help="of the test signal")
    commissions.add_argument("--trials", default="40", help="candidates of gains (default: 40)")
    commissions.add_argument("--yes", action="store_true", help="do not ask before it moves")


class Commission:
    """The steps of a commissioning in their order; each result is kept, so that it can go on."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        from pea_measure import commissioning, plans

        self.arguments = arguments
        self.mode, self.options = measure.mode_of(arguments)
        self.base = plans.Base(arguments.experiment, tuple(arguments.sets), arguments.rig)
        self.trials = whole("--trials", arguments.trials, 1, 10_000)
        self.at, amplitude = (
            None if text is None else number(name, text, -1e4, 1e4, unit)
            for name, text, unit in (
                ("--at", arguments.at, "um"),
                ("--amplitude", arguments.amplitude, "V"),
            )
        )
        self.made = commissioning.measurements(self.base, self.at, amplitude)
        if arguments.step is not None and arguments.step not in STEPS:
            raise ParameterError(f"--step {arguments.step!r}: {nearest(arguments.step, STEPS)}")
        if arguments.step not in (None, "measure") and arguments.out is None:
            raise ParameterError(
                f"--step {arguments.step}: give --out, where the steps before it are"
            )
        self.of = {"trials": self.trials, "at_um": self.at, "amplitude_V": amplitude}

    def begin(self) -> None:
        """Refuse a driver that cannot be made; make the directory, or continue in it."""
        from pea_experiment.checks import refuse_driver

        for each in self.made.values() if self.options else ():
            refuse_driver(each.experiment)
        self.steps = work_in(self.arguments, "commission", self.of)

    def may(self, lines: list[str]) -> bool:
        """Print what will be done; ask for consent if a rig moves."""
        return agreed(lines, self.arguments.yes or not self.arguments.rig)

    def needs(self, name: str) -> dict[str, Any]:
        """Result of an earlier step.

        Raises
        ------
        ParameterError
            The step is not done.
        """
        found: dict[str, Any] | None = self.steps.done(name)
        if found is None:
            raise ParameterError(f"{self.steps.there}: step {name} is not done yet; do it first")
        return found

    def measure(self) -> None:
        """Carry out the measurements that are not done yet."""
        left = {n: m for n, m in self.made.items() if self.steps.done(n) is None}
        if left and not self.may([m.announced() for m in left.values()]):
            raise KeyboardInterrupt
        for name, measurement in left.items():
            self.moved(name, measurement)

    def moved(self, name: str, measurement: Any) -> dict[str, Any]:
        """Carry out a measurement as a step."""
        with bar(err, self.arguments.json) as shown:
            task = shown.add_task(name, total=measurement.experiment.samples)
            found: dict[str, Any] = self.steps.measured(
                name,
                measurement,
                self.mode,
                lambda k: shown.update(task, completed=k),
                **self.options,
            )
        return found

    def identify(self) -> None:
        """Identify the stage."""
        from pea_measure import commissioning
        from pea_measure.analysis import by_stamps
        from pea_record.read import load

        if self.steps.done("identify") is not None:
            return
        samples = {}
        for name in commissioning.MEASURED:
            recording = load(Path(self.needs(name)["run"]))
            T_ns = self.made[name].experiment.T_ns
            samples[name], _ = by_stamps(recording.samples, recording.stamps, T_ns)
        self.steps.keep("identify", commissioning.identified(self.base, self.made, samples))

    def propose(self) -> None:
        """Propose gains."""
        from pea_measure import proposing

        if self.steps.done("propose") is not None:
            return
        model = self.needs("identify")
        with bar(err, self.arguments.json) as shown:
            task = shown.add_task("gains", total=self.trials)
            found = proposing.proposed(
                self.base,
                model,
                self.trials,
                self.steps.place("gains"),
                lambda done, best: shown.update(task, completed=done),
            )
        self.steps.keep("propose", found)

    def check(self) -> None:
        """Check the gains on every plant."""
        from pea_measure import proposing

        if self.steps.done("check") is not None:
            return
        model, gains = self.needs("identify"), self.needs("propose")["gains"]
        rows = proposing.checked(self.base, model, gains)
        told = {
            plant: {n: v if math.isfinite(v) else None for n, v in row.items()}
            for plant, row in rows.items()
        }
        self.steps.keep("check", told)

    def run(self) -> None:
        """Close the loop with the gains: margins and steps as measured."""
        from pea_measure import plans, proposing

        self.needs("check")
        model, gains = self.needs("identify"), self.needs("propose")["gains"]
        of_loop = [one for one in model["sets"] if not one.startswith("plant.")]
        sets = (*self.base.sets, *of_loop, *proposing.gain_sets(gains))
        base = plans.Base(self.base.name, sets, self.base.rig)
        allowed, _ = plans.middle(base, self.at)
        T_s = base.load(["reference.type=constant"]).T_s
        made = {
            "loop": plans.injected(base, "loop", self.at, {}),
            "steps": plans.steps(
                base, self.at, [0.02 * allowed.stroke], 3, max(0.2, 60.0 * T_s), False
            ),
        }
        left = {n: m for n, m in made.items() if self.steps.done(n) is None}
        if left and not self.may([m.announced() for m in left.values()]):
            raise KeyboardInterrupt
        for name, measurement in left.items():
            self.moved(name, measurement)

    def report(self) -> None:
        """Write the report and print the results."""
        from pea_report.commission import write

        found = {n: self.needs(n) for n in ("identify", "propose", "check", "loop", "steps")}
        if not (self.steps.there / "commission.html").exists():
            title = f"Commissioning of {self.arguments.rig or self.arguments.experiment}"
            runs = {n: self.needs(n)["run"] for n in (*self.made, "loop", "steps")}
            write(self.steps.there, title, found, runs)
        if self.arguments.json:
            told: dict[str, Any] = {n: found[n] for n in ("identify", "propose", "check")}
            told["directory"] = str(self.steps.there)
            print(json.dumps(told), flush=True)
            return
        table = Table("", "value", "95 %", title="identified", title_justify="left")
        for name, row in found["identify"]["parameters"].items():
            half = row.get("half_width_95")
            table.add_row(name, f"{row['value']:.5g}", "–" if half is None else f"± {half:.2g}")
        out.print(table)
        for sentence in found["identify"]["sentences"]:
            out.print(sentence, highlight=False, markup=False)
        table = Table("gain", "value", title="proposed", title_justify="left")
        for name, value in found["propose"]["gains"].items():
            table.add_row(name, f"{value:.6g}")
        out.print(table)
        for name in ("loop", "steps"):
            measure.show(found[name])
        out.print(f"{self.steps.there}/commission.html")


def _commission(arguments: argparse.Namespace) -> int:
    commission = Commission(arguments)
    if arguments.dry_run:
        agreed([m.announced() for m in commission.made.values()], True)
        return 0
    commission.begin()

    def work() -> int:
        for step in STEPS if arguments.step is None else (arguments.step,):
            getattr(commission, step)()
        return 0

    return measure.attempted(work, commission.steps.there)


COMMANDS = {"commission": _commission}
