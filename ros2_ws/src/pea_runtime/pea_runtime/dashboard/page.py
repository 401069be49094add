"""The page: controls on the left, health above, plots in the middle, the stop always in sight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from html import escape
from typing import Any

from nicegui import run, ui

from pea_core.params import ParameterError, Value
from pea_runtime.dashboard import fields
from pea_runtime.dashboard.desk import HEALTH, Desk
from pea_runtime.dashboard.link import Change

REFRESH = 0.25
"""Seconds between two looks of a page at the desk."""

MODES = {"composed": "composed: one process", "distributed": "distributed: nodes over topics"}

STATES = {
    "idle": ("none", "no loop runs"),
    "starting": ("warning", "starting"),
    "running": ("good", "running"),
    "standing": ("warning", "stands still"),
    "fault": ("bad", "FAULT"),
}

LEVELS = "pea-none pea-good pea-warning pea-bad"
"""Classes of what a text may be."""

NODE_TITLES = {
    "controller": "Controller",
    "observer": "Observer",
    "reference": "Reference",
    "plant": "Plant and safety",
}


class Page:
    """One browser's page.

    Parameters
    ----------
    desk : Desk
    stop_port : int
        Port of the emergency stop.
    """

    def __init__(self, desk: Desk, stop_port: int) -> None:
        self.desk = desk
        self._layout = desk.tuning.layout
        self._updates: list[Callable[[], None]] = []
        self._fields: dict[str, fields.Field] = {}
        self._head(stop_port)
        self._header()
        self._side()
        with ui.column().classes("w-full gap-0"):
            self._health()
            self.scope = ui.element("pea-scope")
            if desk.recordings.named:
                self.scope.props(f'source="{escape(desk.recordings.named)}"')
        ui.timer(REFRESH, self._refresh)

    def _head(self, stop_port: int) -> None:
        ui.add_head_html(
            f'<meta name="pea-stop-port" content="{stop_port}">'
            '<link rel="stylesheet" href="/pea-static/style.css">'
            '<script src="/pea-static/stop.js"></script>'
            '<script src="/pea-static/scope.js"></script>'
        )

    # Header and health

    def _header(self) -> None:
        with ui.header().classes("p-0"), ui.column().classes("w-full gap-0"):
            with ui.row().classes("w-full items-center no-wrap px-4 py-2 gap-4"):
                ui.button(icon="menu", on_click=lambda: self.drawer.toggle()).props(
                    "flat dense aria-label='show or hide the controls'"
                )
                ui.label("pea").classes("pea-brand")
                title = ui.label().classes("pea-dim ellipsis")
                state = ui.label().classes("text-weight-bold").classes("at-state")
                reset = ui.button("Reset gate", on_click=lambda: self._gate("reset"))
                enable = ui.button("Enable", on_click=lambda: self._gate("enable"))
                for button in (reset, enable):
                    button.props("outline dense no-caps").set_visibility(False)
                ui.space()
                contrast = ui.button(icon="contrast").props("flat dense aria-label='light or dark'")
                contrast.on("click", js_handler="() => Quasar.Dark.toggle()")
                ui.html(
                    '<button id="pea-stop" type="button">STOP <small>Esc</small></button>',
                    sanitize=False,
                )
            ui.html('<div id="pea-stopped" role="alert"></div>', sanitize=False).classes("w-full")

        def update() -> None:
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

        self._updates.append(update)

    async def _gate(self, service: str) -> None:
        """Ask the plant for a service of its gate."""
        answered = await run.io_bound(self.desk.stop.ask, service)
        if answered is None or not answered.safe:
            self._refuse("nobody serves it" if answered is None else answered.text)

    def _health(self) -> None:
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

        self._updates.append(update)

    # Controls

    def _side(self) -> None:
        with ui.left_drawer(value=None, bordered=False).props("width=350") as self.drawer:
            self.drawer.classes("p-0 pea-side gap-0")
            with ui.expansion("Run", value=True).classes("w-full"):
                self._run()
            with ui.expansion("Controller", value=True).classes("w-full"):
                self._tuning()
            self._node("observer")
            self._node("reference")
            self._node("plant")
            with ui.expansion("Changes").classes("w-full"):
                self._history()
            with ui.expansion("Recordings", value=bool(self.desk.recordings.named)).classes(
                "w-full"
            ):
                self._recordings()
            with ui.expansion("ROS graph").classes("w-full"):
                self._graph()

    def _run(self) -> None:
        desk = self.desk
        if desk.attached:
            ui.label("Attached: start and end the run where it was started.").classes("pea-dim")
            return
        plan = desk.plan
        experiment = (
            ui.select(
                sorted({*desk.experiments, plan.experiment}),
                label="experiment",
                value=plan.experiment,
                on_change=lambda e: self._plan(experiment=e.value),
            )
            .classes("w-full")
            .props("dense options-dense")
        )
        mode = (
            ui.select(
                MODES, label="mode", value=plan.mode, on_change=lambda e: self._plan(mode=e.value)
            )
            .classes("w-full")
            .props("dense options-dense")
        )
        rig = (
            ui.select(
                {name: name or "simulated actuator" for name in ("", *desk.rigs, plan.rig)},
                label="rig",
                value=plan.rig,
                on_change=lambda e: self._plan(rig=e.value),
            )
            .classes("w-full")
            .props("dense options-dense")
        )
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
        with ui.row().classes("w-full no-wrap q-mt-sm"):
            start = ui.button("Start", on_click=self._start).props("unelevated no-caps")
            start.classes("at-start")
            stop = ui.button("End run", on_click=self._end).props("outline no-caps")
            stop.classes("at-end")

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

        self._updates.append(update)

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
        await self._try(self.desk.start)

    async def _end(self) -> None:
        await self._try(self.desk.end)

    async def _try(self, do: Callable[[], Any]) -> None:
        """Do something beside the page; say why where it is refused."""
        try:
            await run.io_bound(do)
        except ParameterError as error:
            self._refuse(str(error))

    def _tuning(self) -> None:
        desk = self.desk
        verdict = ui.label().classes("w-full").classes("at-verdict")
        with ui.row().classes("w-full no-wrap gap-2"):
            apply = (
                ui.button("Apply", on_click=self._apply)
                .props("unelevated dense no-caps")
                .classes("at-apply q-px-md")
            )
            undo = ui.button("Undo", on_click=self._undo).props("outline dense no-caps")
            undo.classes("at-undo q-px-md")
            drop = ui.button("Discard", on_click=desk.tuning.forget).props("flat dense no-caps")

        def update() -> None:
            level, text = desk.tuning.verdict
            _set_text(verdict, text)
            _level(verdict, level)
            apply.set_enabled(desk.running and bool(desk.tuning.changes))
            undo.set_enabled(desk.running and desk.tuning.undoable)
            drop.set_enabled(bool(desk.tuning.changes))

        self._updates.append(update)
        self._fields["controller"] = fields.Field(desk.tuning, "controller", self._refuse)

    async def _apply(self) -> None:
        await self._try(lambda: self.desk.tuning.apply(self.desk.link))

    async def _undo(self) -> None:
        await self._try(lambda: self.desk.tuning.undo(self.desk.link))

    def _refuse(self, text: str) -> None:
        ui.notify(text, type="negative", multi_line=True, timeout=0, close_button="Close")

    def _node(self, node: str) -> None:
        with ui.expansion(NODE_TITLES[node]).classes("w-full"):
            self._fields[node] = fields.Field(self.desk.tuning, node, self._refuse)

    def _history(self) -> None:
        box = ui.html(sanitize=False).classes("w-full").classes("at-changes")

        def update() -> None:
            rows = [_change(change) for change in reversed(self.desk.tuning.history[-20:])]
            _set_content(box, "".join(rows) or "none yet")

        self._updates.append(update)

    def _recordings(self) -> None:
        names = ["", *self.desk.recordings.names]
        select = (
            ui.select(
                {name: name.rpartition("/")[2] or "the running loop" for name in names},
                label="show",
                value=self.desk.recordings.named,
            )
            .classes("w-full")
            .props("dense options-dense")
        )
        select.on_value_change(lambda e: ui.run_javascript(f"peaScope.open({e.value!r})"))

        def look_again() -> None:
            names = ["", *self.desk.recordings.names]
            if set(names) != set(select.options):
                select.set_options({n: n.rpartition("/")[2] or "the running loop" for n in names})

        ui.button("Look again", on_click=look_again).props("flat dense")
        ui.label("Drag the slider above the plots, or zoom with the wheel.").classes("pea-dim")

    def _graph(self) -> None:
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

        self._updates.append(update)

    def _refresh(self) -> None:
        """Show what has changed since the last look."""
        layout = self.desk.tuning.layout
        for field in self._fields.values():
            if layout != self._layout:
                field.rebuild()
            field.update()
        self._layout = layout
        for update in self._updates:
            update()


def _level(label: Any, level: str) -> None:
    if f"pea-{level}" not in label._classes:
        label.classes(add=f"pea-{level}", remove=LEVELS)


def _set_text(label: Any, text: str) -> None:
    if label.text != text:
        label.set_text(text)


def _set_content(box: Any, content: str) -> None:
    if box.content != content:
        box.set_content(content)


def _change(change: Change) -> str:
    """A change as the list has it."""
    author = change.author.rpartition("/")[2]
    head = " · ".join(filter(None, (f"{change.at:.2f} s", change.role, author)))
    values = ", ".join(f"{name} = {_short(value)}" for name, value in change.after.items())
    return (
        f"<div class='pea-change'><div class='pea-dim'>{escape(head)}</div>{escape(values)}</div>"
    )


def _short(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _names(names: tuple[str, ...]) -> str:
    return escape(", ".join(names)) or "–"
