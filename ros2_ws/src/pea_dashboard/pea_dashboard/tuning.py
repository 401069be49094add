"""Values that are being thought of, judged before they are applied; and what was changed.

Nothing here has a rule of its own: ranges are those of the blocks' parameters, the margin is that
of the guard, and values are set by the services that ``pea param`` uses.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pea_core import config
from pea_core.block import changed
from pea_core.config import NODES, NodeParams
from pea_core.params import ParameterError, Spec, Value, build, flatten, layer, specs
from pea_dashboard.link import Link, ParameterChange
from pea_experiment.checks import within_stroke
from pea_experiment.experiment import SCHEMAS, Experiment
from pea_lab.guard import BOUNDLESS, altered, experiment_of, judge, margins
from pea_lab.tune_results import preset

ENOUGH = 10.0
"""Margin up to which one is looked for."""

KEPT = 100
"""Changes remembered."""

SAVED = ("controller", "observer")
"""Nodes of which a preset is saved."""

NAME = "[A-Za-z][A-Za-z0-9_-]{0,59}"
"""What a preset may be called."""


class Verdict(NamedTuple):
    """Judgement of the values that the user considers.

    Attributes
    ----------
    level : str
        ``none``, ``good``, ``warning`` or ``bad``.
    text : str
        One line.
    """

    level: str
    text: str


NOTHING = Verdict("none", "")


def _begins(
    node: str, values: Mapping[str, object], chosen: Mapping[str, object]
) -> dict[str, Any]:
    """Values at which parameters begin: the defaults, and the preset of a type that is chosen."""
    schema = SCHEMAS[node]
    defaults = {name: spec.default for name, spec in specs(schema, values).items()}
    own = config.begun(node, schema, chosen)
    return {name: own.get(name, default) for name, default in defaults.items()}


class Tuning:
    """Values of the four blocks: those in force, and those that are thought of.

    Attributes
    ----------
    base : dict of str to dict
        Values in force: of the nodes that run, else of the experiment that would.
    draft : dict of str to dict
        What shall be different.
    verdict : Verdict
        Of the draft.
    history : list of ParameterChange
        What was changed in this run, by whomever; the last one last.
    layout : int
        Counts up when other parameters are to be shown.
    kept : dict of str to dict
        What was tuned in the run that has ended; empty while one runs, and when it is discarded.
    """

    def __init__(self) -> None:
        self.base: dict[str, dict[str, Value]] = {node: {} for node in NODES}
        self.draft: dict[str, dict[str, Value]] = {node: {} for node in NODES}
        self.verdict = NOTHING
        self.history: list[ParameterChange] = []
        self._undo: list[ParameterChange] = []
        self._undoing: tuple[str, Mapping[str, Value]] = ("", {})
        self.layout = 0
        self.live = False
        self.kept: dict[str, dict[str, Value]] = {}
        self._lock = threading.RLock()

    def rest_on(self, values: Mapping[str, Mapping[str, Value]], live: bool) -> None:
        """Take the values in force; `live`: a loop runs with them."""
        with self._lock:
            own = specs(NodeParams)
            base = {
                node: {n: v for n, v in values.get(node, {}).items() if n not in own or n == "T_s"}
                for node in NODES
            }
            if live != self.live or any(
                base[node].keys() != self.base[node].keys()
                or base[node].get("type") != self.base[node].get("type")
                for node in NODES
            ):
                self.layout += 1
            self.base, self.live = base, live
            if live:
                self.kept = {}
            for node in NODES:
                self.draft[node] = self._other(node, self.draft[node])

    def began(self) -> None:
        """Forget the changes and the draft of the run before."""
        with self._lock:
            self.history, self._undo, self.kept = [], [], {}
            self.draft = {node: {} for node in NODES}

    @property
    def tuned(self) -> dict[str, dict[str, Value]]:
        """Values in force that are others than when the run began, of each node that has some."""
        found: dict[str, dict[str, Value]] = {}
        for role in NODES:
            changes = [change for change in self.history if change.role == role]
            first = {n: v for change in reversed(changes) for n, v in change.before.items()}
            own = {n: self.base[role][n] for c in changes for n in c.after if n in self.base[role]}
            if own := {n: v for n, v in own.items() if first.get(n) != v}:
                found[role] = own
        return found

    def keep(self, tuned: Mapping[str, Mapping[str, Value]]) -> None:
        """Think of what was tuned in a run that has ended, for the next one."""
        with self._lock:
            self.kept = {node: dict(values) for node, values in tuned.items()}
            for node, values in self.kept.items():
                with contextlib.suppress(ParameterError):  # of another experiment
                    self.think(node, values)

    def save(self, folder: Path, name: str) -> Path:
        """Write law and observer as they are thought of as a preset; its file, which is new.

        Raises
        ------
        ParameterError
            The name cannot be one, the file exists, or cannot be written.
        """
        if not re.fullmatch(NAME, name):
            raise ParameterError(
                f"preset {name!r}: must have 1 to 60 letters, digits, - and _, a letter first"
            )
        experiment = experiment_of(
            {node: {**self.values(node), "T_s": self.base[node]["T_s"]} for node in NODES}
        )
        path = folder / f"{name}.yaml"
        text = config.dump({node: preset(experiment, node) for node in SAVED})
        try:
            folder.mkdir(exist_ok=True)
            with open(path, "x", encoding="utf-8") as file:
                file.write(text)
        except FileExistsError:
            raise ParameterError(f"{path}: exists already; give another name") from None
        except OSError as error:
            raise ParameterError(f"{path}: {error.strerror}") from None
        self.layout += 1  # lists have it now
        return path

    @property
    def undoable(self) -> bool:
        """Whether there is a change to take back."""
        return bool(self._undo)

    def values(self, node: str) -> dict[str, Value]:
        """Values of a node with the draft laid over them."""
        schema = SCHEMAS[node]
        known = {n: v for n, v in self.base[node].items() if n != "T_s"}
        if not known:
            return dict(self.draft[node])
        chosen = layer(schema, known, self.draft[node])
        return {**_begins(node, chosen, self.draft[node]), **chosen}

    def specs(self, node: str) -> dict[str, Spec]:
        """Parameters of a node that can be changed now, in their order."""
        if not self.base[node]:
            return {}
        found = specs(SCHEMAS[node], self.values(node))
        return {name: spec for name, spec in found.items() if not (self.live and spec.fixed)}

    def think(self, node: str, values: Mapping[str, Value]) -> None:
        """Put values into the draft; those in force leave it.

        Raises
        ------
        ParameterError
            One breaks its rule.
        """
        with self._lock:
            merged = {**self.draft[node], **values}
            known = specs(SCHEMAS[node], {**self.base[node], **merged})
            checked = {
                name: known[name].check(f"{node}.{name}", value)
                for name, value in merged.items()
                if name in known
            }
            if "type" in values:
                self.layout += 1
            self.draft[node] = self._other(node, checked)

    def _other(self, node: str, values: Mapping[str, Value]) -> dict[str, Value]:
        """Those of some values that would not be in force without being set.

        Where they choose another type, a value that the type before has too is not in force.
        """
        schema, (own, base) = SCHEMAS[node], config.split(self.base[node])
        if not base:
            return dict(values)
        types = {n: v for n, v in values.items() if n == "type" or n.endswith(".type")}
        rest = layer(schema, base, types)
        found = _begins(node, rest, types) | rest
        found |= own | {n: base.get(n) for n in types}
        return {n: v for n, v in values.items() if found.get(n) != v}

    def preset(self, node: str, name: str) -> None:
        """Think of a preset's values."""
        values = config.replaced(node, SCHEMAS[node], {"preset": name})
        with self._lock:
            self.draft[node] = {}
            self.think(node, values)
            self.layout += 1

    def forget(self) -> None:
        """Think of nothing."""
        with self._lock:
            self.draft, self.kept = {node: {} for node in NODES}, {}
            self.verdict = NOTHING
            self.layout += 1

    @property
    def changes(self) -> dict[str, dict[str, Value]]:
        """The draft of each node that has one."""
        return {node: dict(values) for node, values in self.draft.items() if values}

    @property
    def sets(self) -> dict[str, Value]:
        """The draft as after ``--set``."""
        return {
            f"{node}.{name}": value
            for node, values in self.changes.items()
            for name, value in values.items()
        }

    def over(self, sets: Mapping[str, object]) -> dict[str, Any]:
        """The draft laid over other values as after ``--set``: another type replaces theirs."""
        found = dict(sets)
        for node, values in self.changes.items():
            prefix = f"{node}."
            before = {n.removeprefix(prefix): found.pop(n) for n in sets if n.startswith(prefix)}
            own, block = config.split(before)
            if "type" in values:
                own.pop("preset", None)
            merged = {**own, **layer(SCHEMAS[node], block, values)}
            found |= {prefix + name: value for name, value in merged.items()}
        return found

    def judge(self) -> Verdict:
        """Judge the draft as the guard would; keep the verdict."""
        with self._lock:
            changes, base = self.changes, {node: dict(self.base[node]) for node in NODES}
        self.verdict = _verdict(base, changes, self.live) if all(base.values()) else NOTHING
        return self.verdict

    def apply(self, link: Link) -> None:
        """Set the draft, of each node all together; if one refuses, nothing is changed.

        Raises
        ------
        ParameterError
            A node refuses; the text is its reason.
        """
        changes = self.changes
        done: list[tuple[str, dict[str, Value]]] = []
        for node, values in changes.items():
            before = back(node, self.base[node], values)
            try:
                link.set(node, values)
            except ParameterError:
                for other, old in reversed(done):
                    link.set(other, old)
                raise
            done.append((node, before))
        with self._lock:  # what the nodes tell comes later
            self.base = {node: {**self.base[node], **changes.get(node, {})} for node in NODES}
            self.draft = {node: {} for node in NODES}
            self.verdict = NOTHING

    def undo(self, link: Link) -> None:
        """Take back the last change that was seen, by whomever.

        Raises
        ------
        ParameterError
            There is none, or the node refuses.
        """
        if not self._undo:
            raise ParameterError("nothing to undo: nothing was changed since the start")
        change = self._undo.pop()
        values = back(change.role, {**self.base[change.role], **change.before}, change.after)
        self._undoing = (change.role, values)
        try:
            link.set(change.role, values)
        except ParameterError:
            self._undo.append(change)
            raise

    def changed(self, change: ParameterChange) -> None:
        """Remember a change that a node tells."""
        self.history = [*self.history, change][-KEPT:]
        role, values = self._undoing
        if change.role == role and change.after.items() <= values.items():
            self._undoing = ("", {})
        else:
            self._undo = [*self._undo, change][-KEPT:]


def back(node: str, base: Mapping[str, Value], values: Mapping[str, Value]) -> dict[str, Value]:
    """Values to set so that `values` are as they were in `base` again."""
    if "type" not in values:
        return {name: base[name] for name in values if name in base}
    old, now = (specs(SCHEMAS[node], each) for each in (base, {**base, **values}))
    fixed = {name for name, spec in now.items() if spec.fixed}
    return {name: base[name] for name in old if name in base and name not in fixed}


def _verdict(
    base: Mapping[str, Mapping[str, Value]],
    changes: Mapping[str, Mapping[str, Value]],
    live: bool,
) -> Verdict:
    try:
        experiment = experiment_of(base)
        params = {}
        for node, values in changes.items():
            schema, now = SCHEMAS[node], experiment.nodes[node].params
            if live:
                params[node] = changed(schema, now, dict(values))
            else:  # nothing is fixed yet
                params[node] = build(schema, layer(schema, flatten(schema, now), values))
        after = altered(experiment, params)
        loop = after.loop()  # every block designs, or says why it cannot
        if "reference" in changes:
            within_stroke(loop.reference, round(1.0 / after.T_s), after.nodes["plant"].params)
        return _margins(experiment, after, params)
    except ParameterError as error:
        return Verdict("bad", str(error))


def _margins(experiment: Experiment, after: Experiment, params: Mapping[str, object]) -> Verdict:
    tuning = after.nodes["controller"].params.tuning
    found = margins(after, ENOUGH)
    if found == BOUNDLESS:
        return Verdict("warning", "no margin: law or observer is not linear")
    gain = f"{found.gain:.3g}" if found.gain < ENOUGH else f"above {ENOUGH:g}"
    gain += f" at the {found.place}" if found.gain < ENOUGH else ""
    delay = f"{found.delay:.3g} samples" if math.isfinite(found.delay) else "any"
    told = (
        f"gain margin {gain} (at least {tuning.gain_margin:g}), "
        f"delay margin {delay} (at least {tuning.delay_margin:g})"
    )
    running = {node: experiment.nodes[node].params for node in experiment.nodes}
    reason = judge(experiment, params, running) if params else None
    if reason and tuning.guard == "refuse":
        return Verdict("bad", f"will be refused: {reason}")
    enough = found.gain >= tuning.gain_margin and found.delay >= tuning.delay_margin
    return Verdict("good" if enough else "warning", told)
