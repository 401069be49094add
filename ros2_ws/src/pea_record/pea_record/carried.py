"""Files that a run has read, as text that goes with its recording and its parameters.

A recording is complete by itself: what a reference or a load was read from, a text file or a
bag, is kept as a table of the times (s) and values that came of it. Read back it gives the same
bits, whatever becomes of the file or of the rules by which it was read. A picture is kept byte
by byte.
"""

from __future__ import annotations

import atexit
import base64
import binascii
import contextlib
import hashlib
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

from pea_core.config import PICTURES
from pea_core.params import ParameterError
from pea_core.tables import Table

PREFIX = "file "
"""Begin of the key, in the record of where a recording comes from, of each file."""

ENCODED = "base64 of a picture "
"""Begin of the text of a picture; its name's ending follows."""

SPECIMEN = "stage.specimen"
"""Parameter of the plant that may name a picture."""

Sections = Mapping[str, Mapping[str, Any]]


def _models() -> dict[tuple[str, str], Mapping[str, ModuleType]]:
    """Models that may read a file, by node and by how the names of their parameters begin."""
    from pea_plant.model import load  # they take time to import, and not every recording has a file
    from pea_reference import model

    return {("reference", ""): model.MODELS, ("plant", "load."): load.MODELS}


def named(sections: Sections) -> Iterator[tuple[str, str, Callable[[str], str]]]:
    """Node and parameter of every file that the values of nodes name, and who reads its text."""
    for (node, group), models in _models().items():
        values = sections.get(node, {})
        for begin in (group, *(f"{axis}.{group}" for axis in values.get("axes", ()))):
            model = models.get(str(values.get(f"{begin}type")))
            file = getattr(model, "FILE", None)
            if model is not None and file and values.get(begin + file):
                own = {n.removeprefix(begin): v for n, v in values.items()}
                yield node, begin + file, partial(_table, model, own)
    if str(sections.get("plant", {}).get(SPECIMEN, "")).lower().endswith(PICTURES):
        yield "plant", SPECIMEN, _picture


def contents(sections: Sections, folder: Path | None = None) -> dict[str, str]:
    """Text of each file that the values of nodes name, by the name of its parameter.

    Parameters
    ----------
    sections : mapping
        Values of the experiment and of each node.
    folder : Path, optional
        Where names of files begin that are not absolute.
    """
    found = {}
    for node, name, text in named(sections):
        path = str((folder or Path()) / str(sections[node][name]))
        with contextlib.suppress(ParameterError, KeyError, OSError):  # no more there
            found[f"{node}.{name}"] = text(path)
    return found


def _table(model: ModuleType, values: Mapping[str, Any], path: str) -> str:
    values = {**values, model.FILE: path}
    return model.text(values) if hasattr(model, "text") else _text(path, *model.table(values))


def _picture(path: str) -> str:
    there = Path(path)
    data = base64.b64encode(there.read_bytes()).decode()
    return f"{ENCODED}{there.suffix.lower()}\n{data}\n"


def _text(path: str, table: Table, head: str) -> str:
    about = "".join(c if c.isprintable() else "?" for c in f"{path}: {table.understood}")
    rows = zip(table.time.tolist(), table.value.tolist())
    lines = [f"# {about}", f"t [s],{head}", *(f"{t!r},{value!r}" for t, value in rows)]
    return "\n".join(lines) + "\n"


def beside(folder: Path, sections: Sections) -> dict[str, dict[str, Any]]:
    """Write the files into a run's directory; the values that name them there."""
    found = {node: dict(values) for node, values in sections.items()}
    for parameter, text in contents(sections).items():
        node, _, name = parameter.partition(".")
        found[node][name] = _write(folder, parameter, text).name
    return found


def unpacked(record: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """Values that name the files in a recording, which are written out until this process ends.

    Parameters
    ----------
    record : mapping
        Where the recording comes from.
    """
    found: dict[str, dict[str, str]] = {}
    files: dict[str, set[str]] = defaultdict(set, plant={SPECIMEN})
    for (node, begin), models in _models().items():
        files[node] |= {begin + m.FILE for m in models.values() if hasattr(m, "FILE")}
    for key, text in record.items():
        if key.startswith(PREFIX):
            parameter = key.removeprefix(PREFIX)
            node, _, name = parameter.partition(".")
            if {name, name.partition(".")[2]} & files[node]:  # of an axis, too
                found.setdefault(node, {})[name] = str(_write(_folder(), parameter, text))
    return found


def _write(folder: Path, parameter: str, text: str) -> Path:
    """Write a file under a name that no file of other contents has.

    Raises
    ------
    ParameterError
        The text of a picture is none.
    """
    head, _, data = text.partition("\n")
    ending = head.removeprefix(ENCODED)
    picture = ending != head and ending in PICTURES
    name = f"{parameter.rpartition('.')[0]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    there = folder / f"{name}{ending if picture else '.csv'}"
    try:
        there.write_bytes(base64.b64decode(data) if picture else text.encode())
    except binascii.Error:
        raise ParameterError(f"{parameter}: the recording's copy of the file is damaged") from None
    return there


@cache
def _folder() -> Path:
    there = tempfile.mkdtemp(prefix="pea-files-")
    atexit.register(shutil.rmtree, there, ignore_errors=True)
    return Path(there)
