"""The experiment that a recording is of: from its bag, or from the parameter file beside it."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pea_core import config
from pea_core.config import NODES
from pea_core.params import ParameterError
from pea_core.paths import stem
from pea_experiment import experiments
from pea_experiment.experiment import SECTION, AnyExperiment, Experiment
from pea_experiment.experiments import PARAMS
from pea_record import carried
from pea_record.origin import FORMAT, ORIGIN, mapping
from pea_record.read import path_and_axis
from pea_record.recording import BagError, Recording
from pea_wire.topics import NAMESPACE

RUN = {
    "observer": ("observer",),
    "controller": ("controller",),
    "both": ("observer", "controller"),
}
"""Blocks that can run again, by the word for them."""


class Untold(BagError):
    """A recording that does not say what ran, or not all of it."""


def parameters(recording: Recording, path: Path, needed: Sequence[str] = NODES) -> str:
    """Text of the parameter file that a run was started with, from its bag or beside it.

    Raises
    ------
    Untold
        There is none, or a node that is needed is missing in it.
    BagError
        It is of a version that is not known here.
    """
    origin = recording.metadata.get(ORIGIN, {})
    if origin and origin.get("format") != FORMAT:
        raise BagError(f"{path} is of format {origin.get('format')!r}: this version knows {FORMAT}")
    if text := origin.get("parameters"):
        told = mapping(text)
        missing = [name for node in needed if (name := f"{NAMESPACE}/{node}") not in told]
        if told and missing:  # what is no mapping is refused by who reads it
            raise Untold(
                f"{path} does not say what {', '.join(missing)} ran: it did not tell the "
                "recorder; give --params FILE"
            )
        return text
    beside = (path if path.is_dir() else path.parent) / PARAMS
    try:
        return beside.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise Untold(
            f"{path} does not say what ran: no parameters in it, no {PARAMS} beside it; "
            "give --params FILE"
        ) from None


def experiment_of(
    recording: Recording,
    path: Path,
    sets: Sequence[str] = (),
    others: Mapping[str, str] | None = None,
    params: Path | None = None,
) -> Experiment:
    """The experiment that a recording of one axis is of, see `axes_experiment_of`."""
    found = axes_experiment_of(recording, path, sets, others, params)
    assert isinstance(found, Experiment)
    return found


def axes_experiment_of(
    recording: Recording,
    path: Path,
    sets: Sequence[str] = (),
    others: Mapping[str, str] | None = None,
    params: Path | None = None,
    through: str = "",
) -> AnyExperiment:
    """The experiment that a recording is of; of one axis of several that axis alone.

    Parameters
    ----------
    recording : Recording
    path : Path
        Where it was read from.
    sets : sequence of str
        ``NODE.PARAM=VALUE`` each, laid over it.
    others : mapping of str to str, optional
        Presets or types of the observer or the controller to take instead.
    params : Path, optional
        Parameter file to take in place of what the recording says.
    through : str, optional
        One of `THROUGH`: nothing else has to be told. A block that the recording says nothing of
        was a node that is not ours, and stays unknown.

    Raises
    ------
    Untold
        It does not say what ran.
    BagError
        It ran at another T_s than its parameters say, or is of another version.
    ParameterError
        Something that does not go together.
    """
    path, _ = path_and_axis(path)
    if params is not None:
        experiment = experiments.load_axes(str(params), sets, others=others)
    else:
        text = parameters(recording, path, RUN.get(through, NODES))
        record = recording.metadata.get(ORIGIN, {})
        named = record.get("experiment") or path.resolve().name
        try:
            name = stem(named, "experiment")
        except ParameterError:  # of a recorder that has taken any
            name = "recording"
        with tempfile.TemporaryDirectory() as there:
            file = Path(there) / f"{name}.yaml"
            file.write_text(text, encoding="utf-8")
            try:
                untold = _complete(file, record) if record.get("parameters") else []
                experiment = experiments.load_axes(str(file), sets, others=others, untold=untold)
            except ParameterError as error:
                raise ParameterError(str(error).replace(str(file), str(path))) from None
    if recording.T_ns and recording.T_ns != experiment.T_ns:
        raise BagError(
            f"{path} has a sample every {recording.T_ns} ns, and its parameters say "
            f"T_s = {experiment.T_ns} ns"
        )
    return _with_axes(experiment, recording.axes, path, sets)


def _with_axes(
    experiment: AnyExperiment, axes: tuple[str, ...], path: Path, sets: Sequence[str]
) -> AnyExperiment:
    """The experiment with the axes of a recording."""
    if experiment.axes == axes or (len(axes) == 1 and isinstance(experiment, Experiment)):
        return experiment
    if len(axes) == 1 and axes[0] in experiment.axes:
        return experiments.one_of(experiment, axes[0], sets)
    raise BagError(
        f"{path} has the axes {', '.join(axes)}, and its parameters are of "
        f"{', '.join(experiment.axes)}"
    )


def _complete(file: Path, record: Mapping[str, str]) -> list[str]:
    """Let a recording's parameters need no file outside it: every value is there.

    Returns
    -------
    list of str
        Nodes that have told nothing.
    """
    sections = config.read(file, (SECTION, *NODES))
    for node, values in sections.items():
        for name in [name for name in values if name.rpartition(".")[2] == "preset"]:
            del values[name]
        values |= carried.unpacked(record).get(node, {})
    config.write(file, sections)
    return [node for node in NODES if not sections[node]]


def sections(
    recording: Recording, experiment: AnyExperiment, until: int
) -> dict[str, dict[str, Any]]:
    """Values of the experiment and its nodes in force at the stamp `until` (ns)."""
    found = {node: dict(values) for node, values in experiment.sections().items()}
    for event in recording.events:
        node = event.node.removeprefix(f"{NAMESPACE}/")
        if event.stamp <= until and node in NODES:
            known = found[node]
            known.update({n: v for n, v in event.changed.items() if n in known})
    return found


def text(recording: Recording, experiment: AnyExperiment, until: int) -> str:
    """The same as a parameter file."""
    return config.dump(sections(recording, experiment, until))
