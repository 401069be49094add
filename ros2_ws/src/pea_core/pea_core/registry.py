"""Models by name: a package's own, and those that a lab's packages install.

A lab adds a model without a line of ours: its package names the module in an entry point group.

    [project.entry-points."pea.laws"]
    my_law = "my_package.my_law"

The groups are ``pea.laws``, ``pea.observers``, ``pea.references``, ``pea.hysteresis``,
``pea.creep``, ``pea.vibration``, ``pea.loads`` and ``pea.drivers``; ``pea.config`` names a
package of experiments, rigs and presets (`config.files`). What a module must offer, and
what it may declare, stands at the head of the package that holds our own models of that kind.
`BROKEN` says of a name why it cannot be chosen: its module cannot be used, or two modules have it.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import sys
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

from pea_core.entry import line_of
from pea_core.params import Choice

BROKEN: dict[str, dict[str, str]] = {}
"""Entry point group to the names that cannot be chosen, and why."""


@functools.cache
def points() -> Any:
    """Every entry point that is installed; found once, since it takes some 40 ms."""
    return importlib.metadata.entry_points()


def _whole(name: str) -> ModuleType:
    """A module, executed to its end.

    Who imports a model by itself imports the package of its kind through it, and so comes here in
    the middle of the module. It is then begun anew; the outer import gets the new one.
    """
    module = importlib.import_module(name)
    if getattr(module.__spec__, "_initializing", False):
        del sys.modules[name]
        module = importlib.import_module(name)
    return module


def models(
    group: str, own: Mapping[str, ModuleType], needs: Sequence[str], first: str = ""
) -> dict[str, ModuleType]:
    """Modules of one kind of model by name: `own`, then those that are installed.

    Parameters
    ----------
    group : str
        Entry point group.
    own : mapping of str to module
        Models of the package itself.
    needs : sequence of str
        What a module must offer besides ``Params``.
    first : str, optional
        Package whose entry points go before all others, and must work.
    """
    found, broken = dict(own), BROKEN.setdefault(group, {})
    installed = points().select(group=group)
    for point in sorted(installed, key=lambda p: p.module.partition(".")[0] != (first or None)):
        if point.name in found:
            if point.value != (other := found[point.name].__name__):
                broken[point.name] = (
                    f"{other} and {point.value} both have this name; give the one that is yours "
                    "another name in its pyproject.toml, or uninstall it"
                )
            continue
        try:
            module = _whole(point.value)
            Choice({point.name: module.Params}, point.name, "")
            lacks = [name for name in needs if not hasattr(module, name)]
            if lacks:
                raise AttributeError(f"{point.value} lacks {', '.join(lacks)}")
            found[point.name] = module
        except Exception as error:
            if point.module.partition(".")[0] == first:
                raise
            broken[point.name] = _why(error)
    return found


def _why(error: Exception) -> str:
    """Why a module cannot be used, in one line."""
    lacks = line_of(error) if isinstance(error, ModuleNotFoundError) else None
    return lacks or " ".join(f"{type(error).__name__}: {error}".split())


def registry(
    group: str, modules: Mapping[str, ModuleType], default: str, help: str, live: bool = False
) -> Choice:
    """The choice among the models of an entry point group, from their modules.

    `live`: another one may be chosen while the loop runs.
    """
    kinds = {name: module.Params for name, module in modules.items()}
    return Choice(kinds, default, help, fixed=not live, unusable=BROKEN.get(group))
