"""Fields of one node's parameters: a slider and a number each, made from their declarations."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import ui

from pea_core.params import ParameterError, Spec, Value
from pea_dashboard.foreign import plain
from pea_dashboard.tuning import SAVED, Tuning
from pea_experiment.experiments import presets

LONGEST = 4096
"""Characters of a value that are shown: of a path, all."""

DECADES = 1.0
"""How far a slider goes from the value in force, up and down."""

ASIDE = (
    *(
        "zeta",
        "omega_n",
        "K",
        "voltage_min",
        "voltage_max",
        "slew_rate",
        "delay_samples",
        "preview_samples",
    ),
    *(
        "tuning.guard",
        "tuning.gain_margin",
        "tuning.delay_margin",
        "tuning.modulus_margin",
        "tuning.phase_margin",
        "feedforward",
        "eps_compensation",
        "seed",
    ),
)
"""Parameters that are rarely turned: shown under `more`."""


PRESETS = Path("presets")
"""Where presets are saved."""


def saved(node: str) -> list[str]:
    """Presets of a node that were saved, by their paths."""
    if node not in SAVED:
        return []
    with contextlib.suppress(OSError):
        return [str(path) for path in sorted(PRESETS.glob("*.yaml")) if str(path).isprintable()]
    return []


def told(value: Value) -> str:
    """A value as it is typed."""
    if isinstance(value, tuple):
        return ", ".join(f"{each:.9g}" if isinstance(each, float) else str(each) for each in value)
    return f"{value:.9g}" if isinstance(value, float) else plain(value, LONGEST)


def read(spec: Spec, text: str) -> Value:
    """A value that was typed; what it may be the rule of the parameter says."""
    if spec.kind is tuple:
        return tuple(float(part) for part in text.replace(",", " ").split())
    if spec.kind in (int, float):
        return spec.kind(text)
    return text


class Field:
    """All fields of a node.

    Parameters
    ----------
    tuning : Tuning
    node : str
    refuse : callable
        Told why a value cannot be.
    """

    def __init__(self, tuning: Tuning, node: str, refuse: Callable[[str], None]) -> None:
        self.tuning = tuning
        self.node = node
        self.refuse = refuse
        self._shown: dict[str, Callable[[Value, bool], None]] = {}
        self.box = ui.column().classes("w-full gap-1")
        self.rebuild()

    def rebuild(self) -> None:
        """Make the fields anew: other parameters are to be shown."""
        self.box.clear()
        self._shown = {}
        self._last: dict[str, tuple[Value, bool]] = {}
        known = self.tuning.specs(self.node)
        with self.box:
            if not known:
                ui.label("unknown: the node does not report its parameters").classes("pea-dim")
                return
            names = [*presets(self.node), *saved(self.node)]
            if names and self.node != "plant":
                ui.select(names, label="preset", on_change=lambda e: self._preset(e.value)).classes(
                    "w-full"
                ).props(f'dense options-dense aria-label="{self.node} preset"')
            aside = [
                name
                for name in known
                if name in ASIDE or name.startswith("inject.") or self.node == "plant"
            ]
            for name, spec in known.items():
                if name not in aside:
                    self._make(name, spec)
            if aside:
                with ui.expansion("more").classes("w-full").props("dense"):
                    for name in aside:
                        self._make(name, known[name])
        self.update()

    def update(self) -> None:
        """Show the values as they are."""
        values, draft = self.tuning.values(self.node), self.tuning.draft[self.node]
        for name, show in self._shown.items():
            if name in values:
                state = values[name], name in draft
                if state != self._last.get(name):
                    self._last[name] = state
                    show(*state)

    def _think(self, name: str, value: Value) -> None:
        try:
            self.tuning.think(self.node, {name: value})
        except ParameterError as error:
            self.refuse(str(error))
            self._last.pop(name, None)  # show again what is
            self.update()

    def _preset(self, name: str | None) -> None:
        if name:
            try:
                self.tuning.preset(self.node, name)
            except ParameterError as error:
                self.refuse(str(error))

    def _make(self, name: str, spec: Spec) -> None:
        label = f"{self.node} {name}"
        title = f"{name} <small>{spec.unit}</small>"
        with ui.element("div").classes("pea-param") as row:
            ui.html(title, sanitize=False).classes("name").tooltip(f"{spec.help}: {spec.rule}")
            if spec.kind is bool:
                self._switch(name, row, label)
            elif spec.choices:
                self._select(name, spec, row, label)
            else:
                self._number(name, spec, row, label)

    def _switch(self, name: str, row: object, label: str) -> None:
        switch = ui.switch().props(f'dense aria-label="{label}"')
        switch.on("update:model-value", lambda e: self._think(name, bool(switch.value)))

        def show(value: Value, changed: bool) -> None:
            switch.value = value
            _flag(row, changed)

        self._shown[name] = show

    def _select(self, name: str, spec: Spec, row: object, label: str) -> None:
        select = ui.select(list(spec.choices)).props(f'dense options-dense aria-label="{label}"')
        select.on("update:model-value", lambda e: self._think(name, str(select.value)))

        def show(value: Value, changed: bool) -> None:
            select.value = value
            _flag(row, changed)

        self._shown[name] = show

    def _number(self, name: str, spec: Spec, row: Any, label: str) -> None:
        entry = ui.input().props(f'dense input-class=text-right aria-label="{label}"')

        def typed() -> None:
            try:
                value = read(spec, str(entry.value))
            except ValueError:
                self.refuse(f"{name} = {entry.value!r}: must be {spec.rule}")
                self._last.pop(name, None)
                self.update()
                return
            self._think(name, value)

        entry.on("change", typed)  # Enter, or leaving the field
        slider = (
            Slide(self.tuning, self.node, name, spec, self._think) if spec.kind is float else None
        )

        def show(value: Value, changed: bool) -> None:
            entry.value = told(value)
            if slider is not None:
                slider.show(float(value))  # type: ignore[arg-type]
            _flag(row, changed)

        self._shown[name] = show


class Slide:
    """A slider over decades round the value in force; none for a value of zero."""

    def __init__(
        self, tuning: Tuning, node: str, name: str, spec: Spec, think: Callable[[str, Value], None]
    ) -> None:
        self.tuning, self.node, self.name, self.spec = tuning, node, name, spec
        self.slider = ui.slider(min=-DECADES, max=DECADES, step=0.01).props("dense")
        self.slider.props(f'aria-label="slider of {node} {name}"')
        self.slider.on(
            "update:model-value", lambda e: think(name, self._value(float(e.args))), throttle=0.05
        )

    @property
    def _base(self) -> float:
        value = self.tuning.base[self.node].get(self.name)
        return float(value) if isinstance(value, int | float) else 0.0

    def _value(self, position: float) -> float:
        """Value at a position, three digits, within the parameter's range."""
        value = float(f"{self._base * 10.0**position:.3g}") if position else self._base
        low = -math.inf if self.spec.low is None else self.spec.low
        high = math.inf if self.spec.high is None else self.spec.high
        return min(max(value, low), high)

    def show(self, value: float) -> None:
        """Show a value."""
        base = self._base
        usable = base != 0.0 and value / base > 0.0
        self.slider.set_enabled(usable)
        self.slider.value = math.log10(value / base) if usable else 0.0


def _flag(row: Any, changed: bool) -> None:
    row.classes(replace="pea-param changed" if changed else "pea-param")
