"""The page: controls on the left, health above, plots in the middle, the stop always in sight."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

from nicegui import run, ui

from pea_core.config import COMPOSED, DISTRIBUTED
from pea_core.params import ParameterError, Value
from pea_dashboard import fields
from pea_dashboard.desk import HEALTH, Desk
from pea_dashboard.foreign import plain
from pea_dashboard.link import ParameterChange

REFRESH = 0.25
"""Seconds between two looks of a page at the desk."""

MODES = {COMPOSED: "composed: one process", DISTRIBUTED: "distributed: nodes over topics"}

STATES = {
    "idle": ("none", "no loop runs"),
    "starting": ("warning", "starting"),
    "running": ("good", "running"),
    "standing": ("warning", "stands still"),
    "fault": ("bad", "FAULT"),
}

LEVELS = "pea-none pea-good pea-warning pea-bad pea-stale"
"""Classes of what a text may be."""

OTHERS = ("observer", "reference", "plant")

ASIDE: Any = "bottom-right"
"""Where notices are: the fields are on the left."""

REFUSAL = 1000
"""Characters of a refusal that are shown."""

SCRIPTS = ("plot", "path", "scope")
"""Scripts of the plots, in the order in which they need each other."""

Update = Callable[[], None]

log = logging.getLogger(__name__)

NODE_TITLES = {
    "controller": "Controller",
    "observer": "Observer",
    "reference": "Reference",
    "plant": "Plant and safety",
}


class Panel:
    """A part of the page. What cannot be shown in it is said in it, and the others go on.

    Parameters
    ----------
    name : str
    build : callable
        Makes its elements; gives what keeps them up to date.
    """

    def __init__(self, name: str, build: Callable[[], Update | None]) -> None:
        self.name = name
        self._update: Update | None = None
        self.word = ui.label().classes("pea-bad pea-broken")
        self.word.set_visibility(False)
        self.box = ui.element("div").classes("w-full pea-panel")
        with self.box:
            self._try(build)
        self.refresh()

    def refresh(self) -> None:
        """Keep it up to date."""
        if self._update is not None:
            self._try(self._update)

    def _try(self, do: Callable[[], Update | None]) -> None:
        try:
            self._update = do() or self._update
        except Exception as error:  # whatever is to be shown, the stop and the rest stay in reach
            self._say(plain(f"{self.name}: cannot be shown: {type(error).__name__}: {error}"))
        else:
            self._say("")

    def _say(self, text: str) -> None:
        if text != self.word.text:
            self.word.set_text(text)
            self.word.set_visibility(bool(text))
            self.box.classes(**{"add" if text else "remove": "pea-old"})
            if text:
                log.warning(text)


class Page:
    """One browser's page.

    Parameters
    ----------
    desk : Desk
    """

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self._layout = desk.tuning.layout
        self._panels: list[Panel] = []
        self._refusals: list[Any] = []
        self.drawer: Any = None
        ui.add_head_html(
            '<link rel="stylesheet" href="/pea-static/style.css">'
            + "".join(f'<script src="/pea-static/{name}.js"></script>' for name in SCRIPTS)
        )
        with ui.header().classes("p-0"):
            self._panel("header", self._header)
        with ui.left_drawer(value=None, bordered=False).props("width=350") as self.drawer:
            self.drawer.classes("p-0 pea-side gap-0")
            self._side()
        with ui.column().classes("w-full gap-0"):
            self._panel("health", self._health)
            self._panel("plots", self._plots)
        ui.timer(REFRESH, self._refresh)

    def _panel(self, name: str, build: Callable[[], Update | None]) -> None:
        """A part of the page; what goes wrong in it stays in it."""
        self._panels.append(Panel(name, build))

    def _plots(self) -> None:
        scope = ui.element("pea-scope")
        if self.desk.recordings.named:
            scope._props["source"] = self.desk.recordings.named

    # Header and health

    def _header(self) -> Update:
        with ui.row().classes("w-full items-center no-wrap px-4 py-2 gap-4 pea-top"):
            ui.button(icon="menu", on_click=lambda: self.drawer.toggle()).props(
                "flat dense aria-label='show or hide the controls'"
            )
            ui.label("pea").classes("pea-brand").props("role=heading aria-level=1")
            title = ui.label().classes("pea-dim ellipsis")
            state = ui.label().classes("text-weight-bold").classes("at-state")
            state.props("role=status")
            axis = ui.select([], on_change=lambda e: self.desk.look_at(e.value))
            axis.props('dense options-dense aria-label="axis"').classes("at-axis")
            reset = ui.button("Reset gate", on_click=lambda: self._gate("reset"))
            enable = ui.button("Enable", on_click=lambda: self._gate("enable"))
            for button in (reset, enable):
                button.props("outline dense no-caps").set_visibility(False)
            ui.space()
            contrast = ui.button(icon="contrast").props("flat dense aria-label='light or dark'")
            contrast.on("click", js_handler="() => Quasar.Dark.toggle()")

        def update() -> None:
            link = self.desk.link
            axis.set_visibility(link.several)
            if link.several and axis.options != list(link.axes):
                axis.set_options(list(link.axes), value=link.looked_at)
            level, word = STATES[self.desk.state]
            gate, reason = self.desk.gate
            _set_text(state, f"{word}: {reason}" if reason else word)
            _level(state, level)
            reset.set_visibility(gate == "fault")
            enable.set_visibility(gate == "inactive")
            plan = self.desk.child.plan
            told = "attached" if self.desk.attached else ""
            if plan is not None and self.desk.child.runs:
                told = f"{plan.experiment} · {plan.rig or plan.mode}"
            _set_text(title, f"{told} · ROS domain {self.desk.child.domain}".strip(" ·"))

        return update

    async def _gate(self, service: str) -> None:
        """Ask the plant for a service of its gate."""
        answered = await run.io_bound(self.desk.stop.ask, service)
        if answered is None or not answered.safe:
            self._refuse("nobody serves it" if answered is None else answered.text)
        else:
            self._succeed(answered.text)

    def _health(self) -> Update | None:
        desk = self.desk
        items: dict[str, ui.label] = {}
        with ui.element("div").classes("pea-health w-full").classes("at-health"):
            for name in HEALTH:
                with ui.element("div"):
                    ui.label(name).classes("pea-dim")
                    items[name] = ui.label("–").classes(f"pea-num text-weight-medium at-{name}")

        def update() -> None:
            for name, (level, text) in desk.health().items():
                _set_text(items[name], text)
                _level(items[name], level)

        return update

    # Controls

    def _side(self) -> None:
        shown = bool(self.desk.recordings.named)
        parts: list[tuple[str, Callable[[], Update | None], bool]] = [
            ("Run", self._run, True),
            (NODE_TITLES["controller"], self._tuning, True),
            *((NODE_TITLES[node], partial(self._node, node), False) for node in OTHERS),
            ("Changes", self._history, False),
            ("Recordings", self._recordings, shown),
            ("ROS graph", self._graph, False),
        ]
        for title, build, value in parts:
            with ui.expansion(title, value=value).classes("w-full"):
                self._panel(title, build)

    def _run(self) -> Update | None:
        desk = self.desk
        if desk.attached:
            ui.label("Attached: start and end the run where it was started.").classes("pea-dim")
            return None
        plan = desk.plan

        def choice(name: str, options: Any) -> Any:
            """A list that sets one value of the plan."""
            chosen = ui.select(
                options,
                label=name,
                value=getattr(plan, name),
                on_change=lambda e: self._plan(**{name: e.value}),
            )
            return chosen.classes("w-full").props("dense options-dense")

        experiment = choice("experiment", sorted({*desk.experiments, plan.experiment}))
        mode = choice("mode", MODES)
        rigs = {name: name or "simulated actuator" for name in ("", *desk.rigs, plan.rig)}
        rig = choice("rig", rigs)
        with ui.row().classes("w-full items-center no-wrap"):
            duration = (
                ui.number(
                    "seconds",
                    value=plan.duration,
                    min=1e-3,
                    max=1e6,
                    on_change=lambda e: self._plan(duration=e.value),
                )
                .classes("w-24")
                .props("dense")
            )
            wall = ui.switch(
                "on the clock", value=plan.wall, on_change=lambda e: self._plan(wall=e.value)
            )
            record = ui.switch(
                "record", value=plan.record, on_change=lambda e: self._plan(record=e.value)
            )
        ui.label(
            "A recording has every sample from the first on, or there is none: what begins later "
            "could be neither scored nor replayed."
        ).classes("pea-note pea-dim")
        with ui.row().classes("w-full no-wrap items-center q-mt-sm"):
            start = ui.button("Start", on_click=self._start).props("unelevated no-caps")
            start.classes("at-start")
            stop = ui.button("End run", on_click=self._end).props("outline no-caps")
            stop.classes("at-end")
            report = ui.link("Report of the run", "/report", new_tab=True).classes("at-report")

        def update() -> None:
            plan, free = desk.plan, not desk.child.runs and not desk.running
            for element, value in (
                (experiment, plan.experiment),
                (mode, plan.mode),
                (rig, plan.rig),
                (duration, plan.duration),
                (wall, plan.wall),
                (record, plan.record),
            ):
                if element.value != value:
                    element.value = value
                element.set_enabled(free)
            wall.set_enabled(free and not plan.rig)
            start.set_enabled(free)
            stop.set_enabled(desk.child.runs)
            report.set_visibility(bool(desk.child.report))

        return update

    def _plan(self, **values: Any) -> None:
        """Change what shall run; another experiment, or rig, has its own values."""
        if "experiment" in values or "rig" in values:
            values["sets"] = {}
        plan = replace(self.desk.plan, **values)
        if plan != self.desk.plan and not self.desk.child.runs:
            self.desk.plan = plan
            if "sets" in values:
                self.desk.tuning.forget()

    async def _start(self) -> None:
        await self._try(self.desk.start, "started")

    async def _end(self) -> None:
        await self._try(self.desk.end, "the run ends")

    async def _try(self, do: Callable[[], object], done: str) -> None:
        """Do something beside the page; say that it is done, or why it is refused."""
        try:
            await run.io_bound(do)
        except ParameterError as error:
            self._refuse(str(error))
        except Exception as error:  # what nobody has foreseen is said, too
            self._refuse(f"{type(error).__name__}: {error}")
        else:
            self._succeed(done)

    def _tuning(self) -> Update | None:
        desk = self.desk
        verdict = ui.label().classes("w-full").classes("at-verdict").props("role=status")
        with ui.row().classes("w-full no-wrap gap-2"):
            apply = (
                ui.button("Apply", on_click=self._apply)
                .props("unelevated dense no-caps")
                .classes("at-apply q-px-md")
            )
            undo = ui.button("Undo", on_click=self._undo).props("outline dense no-caps")
            undo.classes("at-undo q-px-md")
            drop = ui.button("Discard", on_click=desk.tuning.forget).props("flat dense no-caps")
        kept = ui.label().classes("w-full pea-note at-kept").props("role=status")
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            name = ui.input("preset name").props("dense").classes("col")
            save = ui.button("Save as preset", on_click=lambda: self._save(name))
            save.props("outline dense no-caps").classes("at-save q-px-md")

        def update() -> None:
            level, text = desk.tuning.verdict
            _set_text(verdict, text)
            _level(verdict, level)
            apply.set_enabled(desk.running and bool(desk.tuning.changes))
            undo.set_enabled(desk.running and desk.tuning.undoable)
            drop.set_enabled(bool(desk.tuning.changes))
            told = _sets(desk.tuning.kept)
            _set_text(kept, f"Kept from the run that has ended: {told}. Save it?" if told else "")
            kept.set_visibility(bool(told))
            save.set_enabled(bool(name.value) and bool(desk.tuning.base["controller"]))

        shown = self._node("controller")

        def both() -> None:
            update()
            shown()

        return both

    async def _save(self, name: Any) -> None:
        path = fields.PRESETS / f"{name.value}.yaml"
        done = f"saved: use it with --set controller.preset={path} --set observer.preset={path}"
        await self._try(lambda: self.desk.tuning.save(fields.PRESETS, str(name.value)), done)

    async def _apply(self) -> None:
        tuning = self.desk.tuning
        told = _sets(tuning.changes)
        await self._try(lambda: tuning.apply(self.desk.link), f"applied: {told}")

    async def _undo(self) -> None:
        await self._try(lambda: self.desk.tuning.undo(self.desk.link), "taken back")

    def _refuse(self, text: str) -> None:
        """Say why something was refused, until it is closed or a later change succeeds."""
        self._refusals.append(
            ui.notification(
                plain(text, REFUSAL),
                type="negative",
                position=ASIDE,
                multi_line=True,
                timeout=None,
                close_button="Close",
            )
        )

    def _succeed(self, text: str) -> None:
        """Say that something was done; what was refused before is over."""
        for refusal in self._refusals:
            refusal.dismiss()
        self._refusals.clear()
        ui.notify(plain(text, REFUSAL), type="positive", position=ASIDE, timeout=3000)

    def _node(self, node: str) -> Update:
        field = fields.Field(self.desk.tuning, node, self._refuse)
        layout = self.desk.tuning.layout

        def update() -> None:
            nonlocal layout
            if layout != self.desk.tuning.layout:
                layout = self.desk.tuning.layout
                field.rebuild()
            field.update()

        return update

    def _history(self) -> Update | None:
        box = ui.html(sanitize=False).classes("w-full").classes("at-changes")

        def update() -> None:
            rows = [_change(change) for change in reversed(self.desk.tuning.history[-20:])]
            _set_content(box, "".join(rows) or "none yet")

        return update

    def _recordings(self) -> Update | None:
        def options() -> dict[str, str]:
            names = ["", *self.desk.recordings.names]
            return {name: name.rpartition("/")[2] or "the running loop" for name in names}

        select = (
            ui.select(options(), label="show", value=self.desk.recordings.named)
            .classes("w-full")
            .props("dense options-dense")
        )
        box = ui.html(sanitize=False).classes("w-full").classes("at-parameters")

        async def show(name: str) -> None:
            ui.run_javascript(f"peaScope.open({json.dumps(name)})")
            text = ""
            if name:
                try:
                    found = await run.io_bound(self.desk.recordings.open, name)
                    text = _table(found.parameters if found else {})
                except Exception as error:  # whatever is wrong with it, the plots say it too
                    text = escape(plain(str(error) or type(error).__name__))
            _set_content(box, text)

        select.on_value_change(lambda e: show(e.value or ""))
        if self.desk.recordings.named:
            ui.timer(0.0, lambda: show(self.desk.recordings.named), once=True)

        def look_again() -> None:
            found = options()
            if found != select.options:
                select.set_options({**found, select.value: select.options[select.value]})

        ui.button("Look again", on_click=look_again).props("flat dense")
        ui.label("Drag the slider above the plots, or zoom with the wheel.").classes("pea-dim")
        box.move(target_index=-1)
        return None

    def _graph(self) -> Update | None:
        box = ui.html(sanitize=False).classes("w-full").classes("at-graph")

        def update() -> None:
            rows = "".join(
                f"<tr><td><b>{escape(end.topic)}</b></td>"
                f"<td>{_names(end.publishers)} → {_names(end.subscribers)}</td></tr>"
                for end in self.desk.link.ends
            )
            nodes = escape(", ".join(self.desk.link.nodes)) or "no nodes"
            _set_content(
                box, f"<div class='pea-graph'>{nodes}</div><table class='pea-graph'>{rows}</table>"
            )

        return update

    def _refresh(self) -> None:
        """Show what has changed since the last look."""
        for panel in self._panels:
            panel.refresh()


def _level(label: Any, level: str) -> None:
    if f"pea-{level}" not in label._classes:
        label.classes(add=f"pea-{level}", remove=LEVELS)


def _set_text(label: Any, text: str) -> None:
    text = plain(text, REFUSAL)
    if label.text != text:
        label.set_text(text)


def _set_content(box: Any, content: str) -> None:
    if box.content != content:
        box.set_content(content)


def _change(change: ParameterChange) -> str:
    """A change as the list has it."""
    author = change.author.rpartition("/")[2]
    head = plain(" · ".join(filter(None, (f"{change.at:.2f} s", change.role, author))))
    told = ", ".join(f"{name} = {_short(value)}" for name, value in change.after.items())
    values = plain(told, REFUSAL)
    return (
        f"<div class='pea-change'><div class='pea-dim'>{escape(head)}</div>{escape(values)}</div>"
    )


def _table(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    """Values that a recording was started with."""
    rows = "".join(
        f"<tr><td>{escape(plain(f'{node}.{name}'))}</td><td>{escape(_short(value))}</td></tr>"
        for node, values in parameters.items()
        for name, value in values.items()
    )
    return f"<table class='pea-graph'>{rows}</table>" if rows else "it does not tell its parameters"


def _sets(changes: Mapping[str, Mapping[str, Value]]) -> str:
    """Values of nodes for people."""
    each = [(f"{node}.{n}", v) for node, values in changes.items() for n, v in values.items()]
    return ", ".join(f"{name} = {_short(value)}" for name, value in each)


def _short(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else plain(value)


def _names(names: tuple[str, ...]) -> str:
    return escape(", ".join(names)) or "–"
