"""``pea tune``: gains for a stated goal.

Exit status: 0 done, 2 bad input (one line), 3 no gains with the margin, or the workers are gone.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from pea_cli.options import number, path_of, sets, whole
from pea_core.config import parse
from pea_core.console import bar, err, out
from pea_core.params import ParameterError

if TYPE_CHECKING:
    from pea_experiment.experiment import Experiment, MultiAxis
    from pea_lab import tune

Found = tuple[int, dict[str, float], dict[str, Any]]
"""Exit status, the values that were found by ``NODE.NAME``, and what is told as JSON."""

Search = Callable[[argparse.Namespace, str, "Experiment", Callable[[], Path]], Found]
"""Finds gains of one axis: the command line, the experiment's name, it, what makes a directory."""


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    tunes = commands.add_parser("tune", help="find gains for a stated goal")
    tunes.add_argument("experiment", metavar="EXPERIMENT", help="name, or path of a YAML file")
    tunes.add_argument("--controller", metavar="PRESET", help="law to start from: preset or type")
    tunes.add_argument("--observer", metavar="TYPE", help="another observer: type or preset")
    tunes.add_argument("--plant", metavar="PRESET", help="another plant: preset or hysteresis")
    sets(tunes)
    tunes.add_argument("--duration", metavar="S", help="seconds of loop time of each run")
    tunes.add_argument(
        "--vary",
        metavar="NODE.PARAM=LOW:HIGH",
        action="append",
        default=[],
        help="parameter to search, and its range; may be repeated (default: every gain of the law)",
    )
    tunes.add_argument(
        "--plants",
        metavar="PARAM=VALUE,...",
        help="more plants (default: K and omega_n 10 %% off, other hysteresis)",
    )
    tunes.add_argument("--margin", default="1.3", help="least gain margin (default: 1.3)")
    tunes.add_argument(
        "--from-model",
        action="store_true",
        help="propose gains of state_feedback or pidsmc_modal from its model: no runs, no --trials",
    )
    tunes.add_argument(
        "--from-response",
        metavar="FILE",
        type=path_of,
        help="the same from a frequency response alone: response.csv of pea identify, or "
        "measurement.json of pea measure response",
    )
    for name, default, text in (
        ("bandwidth", "0", "with --from-model: least bandwidth (-3 dB of T, Hz); 0: none"),
        ("modulus", "0.5", "with --from-model: least modulus margin of the model"),
        ("modulus-set", "0.27", "with --from-model: least modulus margin of the set"),
        ("voltage-noise", "1.5", "with --from-model: most noise of K u, in that of the sensor"),
        ("spread-frequency", "0.03", "with --from-model: spread of each frequency, a share"),
        ("spread-gain", "0.1", "with --from-model: spread of the gain, a share"),
    ):
        tunes.add_argument(f"--{name}", metavar="X", default=default, help=f"{text} ({default})")
    tunes.add_argument("--trials", default="160", help="candidates to try (default: 160)")
    tunes.add_argument("--seed", default="0", help="of the search (default: 0)")
    tunes.add_argument("--workers", metavar="N", help="processes (default: one for each core)")
    tunes.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask cluster that runs it"
    )
    tunes.add_argument(
        "--trust-scheduler",
        action="store_true",
        help="allow a tcp:// address, whose peer can run code here",
    )
    for name, what in (("ca-file", "authorities"), ("cert", "certificate"), ("key", "key")):
        text = f"{what} (PEM) for a scheduler at tls://HOST:PORT"
        tunes.add_argument(f"--tls-{name}", metavar="FILE", type=path_of, help=text)
    tunes.add_argument("--out", metavar="DIR", type=path_of, help="new directory of the result")
    tunes.add_argument("--json", action="store_true", help="print the result as JSON")


def plants(text: str) -> dict[str, tuple[str, ...]]:
    """The plant as given, and one for each ``PARAM=VALUE``.

    Raises
    ------
    ParameterError
        Not of that form.
    """
    found: dict[str, tuple[str, ...]] = {"as given": ()}
    for piece in filter(None, (piece.strip() for piece in text.split(","))):
        name, equals, value = piece.partition("=")
        if not equals or parse(value) is None:
            raise ParameterError(f"--plants {piece!r}: write PARAM=VALUE, separated by commas")
        found[piece] = (f"plant.{name.removeprefix('plant.')}={value}",)
    return found


def _security(arguments: argparse.Namespace) -> Any:
    """How to speak to a scheduler: None over plain TCP, which has to be asked for.

    Raises
    ------
    ParameterError
        It is not, or the files of TLS are not complete.
    """
    files = [getattr(arguments, f"tls_{name}") for name in ("ca_file", "cert", "key")]
    address: str = arguments.scheduler or ""
    if not address.startswith("tls://"):
        if any(files):
            raise ParameterError("--tls-ca-file, --tls-cert, --tls-key: are for tls://HOST:PORT")
        if address.startswith("tcp://") and not arguments.trust_scheduler:
            raise ParameterError(
                f"--scheduler {address}: whoever answers there can run code as you; give "
                "tls://HOST:PORT with --tls-ca-file, --tls-cert and --tls-key, or "
                "--trust-scheduler"
            )
        return None
    if not all(files):
        raise ParameterError(
            f"--scheduler {address}: needs --tls-ca-file, --tls-cert and --tls-key"
        )
    for file in files:
        if not file.is_file():
            raise ParameterError(f"{file}: no such file")
    from distributed.security import Security

    make: Any = Security
    ca_file, cert, key = map(str, files)
    return make(
        tls_ca_file=ca_file, tls_client_cert=cert, tls_client_key=key, require_encryption=True
    )


def _tune(arguments: argparse.Namespace) -> int:
    from pea_experiment import experiments
    from pea_experiment.experiment import MultiAxis
    from pea_run.run import directory

    found = experiments.load_axes(*_asked(arguments, arguments.experiment))
    search = _from_model if arguments.from_model or arguments.from_response else _by_search
    if isinstance(found, MultiAxis):
        return _tune_axes(arguments, found, search)
    if arguments.from_response:
        found = _measured(arguments, found)
    make = partial(directory, found, arguments.out, prefix="tune-")
    status, _, told = search(arguments, arguments.experiment, found, make)
    if arguments.json and told:
        print(json.dumps(told), flush=True)
    return status


def _asked(arguments: argparse.Namespace, name: str, more: Sequence[str] = ()) -> tuple[Any, ...]:
    """What `experiments.load` takes: the experiment of this name as the command line wants it."""
    duration = arguments.duration and number("--duration", arguments.duration, 1e-9, 1e6, "s")
    asked = {n: getattr(arguments, n) for n in ("controller", "observer", "plant")}
    others = {node: choice for node, choice in asked.items() if choice}
    return name, [*arguments.sets, *more], duration or None, None, others


def _measured(arguments: argparse.Namespace, experiment: Experiment) -> Experiment:
    """The experiment with the model of a measured response."""
    from pea_experiment import experiments
    from pea_identify import response_files
    from pea_measure.commissioning import of_response

    response = response_files.read(arguments.from_response, experiment.T_s)
    more = of_response(response, experiment)
    return experiments.load(*_asked(arguments, arguments.experiment, more))


def _tune_axes(arguments: argparse.Namespace, experiment: MultiAxis, search: Search) -> int:
    """Each axis by itself, then the coupled loop with the gains of all."""
    from pea_experiment import experiments
    from pea_experiment.experiment import MultiAxis
    from pea_lab import tune, tune_results
    from pea_lab.coupled import check_axes
    from pea_lab.coupled import rows as lines
    from pea_run.run import directory

    if arguments.from_response:
        raise ParameterError(
            f"--from-response {arguments.from_response}: is of one axis; write "
            f"{arguments.experiment}@{experiment.axes[0]}"
        )
    there = directory(experiment, arguments.out, prefix="tune-")
    told: dict[str, Any] = {"experiment": experiment.name, "axes": {}}
    each = []
    for axis, before in zip(experiment.axes, experiment.each, strict=True):
        name = f"{arguments.experiment}@{axis}"
        own = argparse.Namespace(**vars(arguments))
        own.vary = tune.of_axis(experiment.axes, axis, arguments.vary)
        if arguments.vary and not own.vary:  # what was named is of other axes: it stays as it is
            each.append(before)
            continue
        others = experiments.elsewhere(experiment.axes, axis, arguments.sets)
        own.sets = [text for text in arguments.sets if text not in others]
        one = experiments.load(*_asked(own, name))
        status, values, told["axes"][axis] = search(own, name, one, partial(_inside, there, axis))
        if status:
            if arguments.json:
                print(json.dumps(told), flush=True)
            return status
        each.append(tune.varied(before, values))
    figures = told["coupled"] = check_axes(MultiAxis(tuple(each)))
    least = number("--margin", arguments.margin, 1.0, tune.MARGINS)
    if not arguments.json:
        table = Table("", *experiment.axes, title=f"{experiment.name}, coupled")
        table.title_justify = "left"
        for row in lines(figures):
            table.add_row(*row)
        out.print(table)
    if why := tune.too_close(figures, None if arguments.from_model else least):
        status = 3
        err.print(
            f"pea: each axis alone has its margin, but {why}: no preset of all axes is written; "
            "decouple the stage (plant.stage.axes_to_actuators), or ask for more --margin",
            highlight=False,
            markup=False,
        )
    else:
        status, names = 0, ", ".join(tune_results.gather(there, experiment.axes))
        if not arguments.json:
            out.print(f"{names} of all axes, and a directory of each, in {there}", highlight=False)
    if arguments.json:
        print(json.dumps(told), flush=True)
    return status


def _inside(there: Path, axis: str) -> Path:
    path = there / axis
    path.mkdir()
    return path


def _by_search(
    arguments: argparse.Namespace, name: str, experiment: Experiment, make: Callable[[], Path]
) -> Found:
    """Search for gains by runs."""
    from pea_experiment import experiments
    from pea_lab import tune, tune_results

    ranges = dict(tune.range_of(experiment, text) for text in arguments.vary)
    goal = tune.Goal(
        number("--margin", arguments.margin, 1.0, tune.MARGINS),
        plants(arguments.plants) if arguments.plants is not None else tune.plants_of(experiment),
        ranges or tune.gains_of(experiment),
    )
    if not goal.ranges:
        raise ParameterError("this law has no gains; name parameters to search with --vary")
    for own in goal.plants.values():
        experiments.load(*_asked(arguments, name, own))
    trials = whole("--trials", arguments.trials, 1, 10**6)
    seed = whole("--seed", arguments.seed, 0, 2**32 - 1)
    workers = _workers(arguments)
    there = make()
    with workers as hands, bar(err if arguments.json else out) as shown:
        task = shown.add_task("candidates", total=trials)

        def progress(done: int, best: tune.Trial) -> None:
            told = f"best {best.error_nm:.4g} nm, margin {tune.margin_text(best.margin)}"
            shown.update(task, completed=done, description=told)

        found = tune.tune(experiment, goal, trials, seed, hands, progress)
    best = tune.best(found)
    from pea_report.overview import tuned

    tune_results.write(there, experiment, goal, found, seed)
    tuned(there / "tune.html", experiment.name, goal, found)
    if not arguments.json:
        out.print(_compared(_title(name, experiment), goal.ranges, found[0], best))
        what = "presets, " if best.good else ""
        out.print(f"{what}trials.csv, tune.json, tune.png, tune.html in {there}", highlight=False)
    if not best.good:
        err.print(
            f"pea: no candidate has a gain margin of {goal.margin:g} on every plant and comes to "
            "rest there after raw steps: no preset is written; give more "
            "--trials, a wider --vary or a smaller --margin",
            highlight=False,
            markup=False,
        )
    return (0 if best.good else 3), best.values, tune_results.summary(experiment, goal, found, seed)


def _workers(arguments: argparse.Namespace) -> Any:
    """What runs the candidates: processes here, or a cluster.

    Raises
    ------
    ParameterError
        A count of workers for a cluster, or one out of range.
    """
    from pea_lab import tune

    count = arguments.workers and whole("--workers", arguments.workers, 1, 4096)
    if count and arguments.scheduler:
        raise ParameterError("--workers: the cluster of --scheduler has its own")
    security = _security(arguments)
    if arguments.scheduler:
        return tune.Cluster(arguments.scheduler, security)
    return tune.Processes(count)


def _compared(title: str, names: Iterable[str], before: tune.Trial, best: tune.Trial) -> Table:
    """Values and figures of the gains as they were, and of the best that were found."""
    from pea_lab.tune import margin_text

    table = Table("", "before", "found", title=title, title_justify="left")
    both = (before, best)
    for name in names:
        table.add_row(name, *(f"{trial.values[name]:.6g}" for trial in both))
    for figure, unit in (("error_nm", "nm"), ("worst_nm", "nm"), ("step_V", "V")):
        cells = (f"{getattr(trial, figure):.4g} {unit}" for trial in both)
        table.add_row(figure.partition("_")[0], *cells)
    for figure, text in (
        ("command", "gain margin at the command"),
        ("actuator", "gain margin at the actuator"),
        ("margin", "gain margin"),
    ):
        table.add_row(text, *(margin_text(getattr(trial, figure)) for trial in both))
    return table


def _title(name: str, experiment: Experiment) -> str:
    """The experiment's name, and its axis where it is one of several."""
    return f"{experiment.name}, axis {experiment.axis}" if "@" in name else experiment.name


def _from_model(
    arguments: argparse.Namespace, name: str, experiment: Experiment, make: Callable[[], Path]
) -> Found:
    """Propose gains from the model."""
    from pea_core import config
    from pea_lab import proposal, tune, tune_results

    goal = proposal.ProposalGoal(
        bandwidth=number("--bandwidth", arguments.bandwidth, 0.0, 1e6, "Hz"),
        modulus=number("--modulus", arguments.modulus, 0.01, 0.99),
        modulus_set=number("--modulus-set", arguments.modulus_set, 0.01, 0.99),
        voltage=number("--voltage-noise", arguments.voltage_noise, 0.01, 1e3),
        frequency=number("--spread-frequency", arguments.spread_frequency, 0.0, 0.5),
        gain=number("--spread-gain", arguments.spread_gain, 0.0, 0.9),
    )
    params = experiment.nodes["controller"].params
    try:
        found = proposal.propose(params, goal, experiment.T_s)
    except proposal.NoProposal as error:
        err.print(
            f"pea: {error}: no preset is written; give a smaller --modulus, --bandwidth or spread",
            highlight=False,
            markup=False,
        )
        return 3, {}, {}
    named = {f"controller.{name}": value for name, value in found.values.items()}
    figures = found.figures
    about = (
        f"# Proposed by pea tune {experiment.name} --from-model: modulus margin "
        f"{figures.modulus:.3g}, {figures.modulus_set:.3g} over the set,\n"
        f"# -3 dB of T at {figures.bandwidth:.4g} Hz; limited by: {found.limit}.\n"
    )
    there = make()
    preset = tune_results.preset(tune.varied(experiment, named), "controller")
    text = about + config.dump({"controller": preset})
    (there / "controller.yaml").write_text(text, encoding="utf-8")
    told = {**figures._asdict(), "S": figures.S.tolist()}
    told = {"values": found.values, **told, "limit": found.limit}
    if arguments.json:
        return 0, named, told
    table = Table("", "found", title=_title(name, experiment), title_justify="left")
    for value_of, value in found.values.items():
        table.add_row(value_of, f"{value:.6g}")
    table.add_row("modulus margin", f"{figures.modulus:.3g}")
    table.add_row("modulus margin of the set", f"{figures.modulus_set:.3g}")
    table.add_row("-3 dB of T", f"{figures.bandwidth:.4g} Hz")
    table.add_row("limited by", found.limit)
    out.print(table)
    out.print(f"controller.yaml in {there}", highlight=False)
    return 0, named, told


COMMANDS = {"tune": _tune}
