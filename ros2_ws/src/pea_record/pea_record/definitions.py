"""Definition of a message type, as a recording carries it.

From the ROS 2 packages that are installed, or, where there is no ROS, from `rosbags`, which knows
those of Jazzy.
"""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path
from typing import Any

from pea_core.params import ParameterError

_FIELD = re.compile(r"\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]")
"""Type of a field, without the bound of a string and the size of an array."""


class DefinitionError(ParameterError):
    """A message type that no installed package defines."""


def _read(type_name: str, suffix: str) -> str:
    package, _, name = type_name.split("/")
    try:
        from ament_index_python.packages import get_package_share_directory

        share = Path(get_package_share_directory(package))
        return (share / "msg" / f"{name}{suffix}").read_text(encoding="utf-8")
    except (ImportError, LookupError, OSError) as error:  # an unset AMENT_PREFIX_PATH, too
        raise DefinitionError(
            f"no definition of {type_name} ({error}): source the ROS 2 set-up first"
        ) from None


@functools.cache
def _jazzy() -> Any:
    """Types of Jazzy, for a machine without ROS."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _members(type_name: str, text: str) -> list[str]:
    """Names of the message types that the fields of `text` use, in order, each once."""
    package = type_name.split("/")[0]
    found: dict[str, None] = {}
    for line in text.splitlines():
        field = _FIELD.match(line.split("#")[0])
        if field is None or (field[1][0].islower() and "/" not in field[1]):
            continue  # no field, or one of a primitive type: messages are in CamelCase
        *home, name = field[1].split("/")
        if not home and name == "Header":
            home = ["std_msgs"]
        found[f"{home[0] if home else package}/msg/{name}"] = None
    return list(found)


@functools.cache
def schema_text(type_name: str) -> str:
    """Definition of `type_name` (``package/msg/Type``) and of every type it is made of.

    The format is ``ros2msg``: each further definition stands under a line of 80 ``=`` and a line
    ``MSG: package/Type``.

    Raises
    ------
    DefinitionError
        The type or one that it is made of is not installed.
    """
    try:
        texts = {type_name: _read(type_name, ".msg")}
    except DefinitionError:
        if type_name not in _jazzy().types:
            raise
        text: str = _jazzy().generate_msgdef(type_name, ros_version=2)[0]
        return text
    open_types = _members(type_name, texts[type_name])
    while open_types:
        member = open_types.pop(0)
        if member not in texts:
            texts[member] = _read(member, ".msg")
            open_types += _members(member, texts[member])
    first, *others = texts
    parts = [texts[first]]
    for member in others:
        package, _, name = member.split("/")
        parts.append(f"{'=' * 80}\nMSG: {package}/{name}\n{texts[member]}")
    return "\n".join(parts)


@functools.cache
def type_hash(type_name: str) -> str:
    """RIHS01 hash of `type_name` (``package/msg/Type``): what ROS 2 compares types by.

    Raises
    ------
    DefinitionError
        The type is not installed.
    """
    try:
        known = json.loads(_read(type_name, ".json"))["type_hashes"]
    except DefinitionError:
        if type_name not in _jazzy().types:
            raise
        return str(_jazzy().hash_rihs01(type_name))
    for entry in known:
        if entry["type_name"] == type_name:
            return str(entry["hash_string"])
    raise DefinitionError(
        f"the definition of {type_name} has no hash: install ROS 2 Jazzy or later"
    )
