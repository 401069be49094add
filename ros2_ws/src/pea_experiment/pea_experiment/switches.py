"""Parameters that another one of their node turns off: typed alone, they have no effect."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

SWITCHES: dict[tuple[str, str], tuple[str, object]] = {
    ("plant", "creep."): ("creep.enabled", False),
    ("controller", "inject."): ("inject.where", "off"),
    ("controller", "learning_"): ("learning", "none"),
    ("controller", "learning."): ("learning.method", "none"),
    ("controller", "damping_"): ("damping", "none"),
    ("reference", "shaper."): ("shaper.type", "none"),
    ("reference", "rise_time"): ("shape", "raw"),
}
"""Node and the begin of its parameters' names, to the switch and the value that turns them off."""


def idle(node: str, typed: Iterable[str], values: Mapping[str, object]) -> list[str]:
    """One line on each parameter that somebody has typed and that has no effect.

    Parameters
    ----------
    node : str
    typed : iterable of str
        Names that were typed.
    values : mapping
        All values of the node.
    """
    said = []
    for name in typed:
        for (of, begin), (switch, off) in SWITCHES.items():
            hit = of == node and name.startswith(begin) and name in values and name != switch
            if hit and values.get(switch) == off:
                told = str(off).lower() if isinstance(off, bool) else off
                said.append(f"{node}.{name}: has no effect while {node}.{switch} = {told}")
    return said
