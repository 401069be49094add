"""Work in steps whose results are kept in a directory: each is done once, and may be resumed.

Each step leaves `NAME.json` when it is done. A run lies in a directory of its own, `NAME`; one
that was interrupted stays, and the next try takes `NAME-2`. Nothing is written over.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pea_core.params import ParameterError
from pea_measure.plans import PlannedMeasurement
from pea_run.measuring import carry_out

STATE = "state.json"
"""What the work is of; it must be the same where work is resumed."""


class Result(dict[str, Any]):
    """What a step has found, by name.

    Parameters
    ----------
    file : Path
        Where it is kept.
    found : dict
    """

    def __init__(self, file: Path, found: Any) -> None:
        if not isinstance(found, dict):
            raise ValueError
        super().__init__(found)
        self._file = file

    def __missing__(self, name: str) -> Any:
        raise ParameterError(
            f"{self._file}: has no {name!r}, as another version has made it; remove it to do this "
            "step again"
        )


class Steps:
    """Steps in a directory.

    Parameters
    ----------
    there : Path
        Made where it does not exist.
    what : dict
        What the work is of.

    Raises
    ------
    ParameterError
        The directory is of other work, or cannot be made.
    """

    def __init__(self, there: Path, what: dict[str, object]) -> None:
        self.there = there
        file = there / STATE
        if there.exists():
            try:
                before = Result(file, json.loads(file.read_text(encoding="utf-8")))
            except (OSError, ValueError):
                raise ParameterError(
                    f"--out {there}: exists and holds no work to resume; name a new directory"
                ) from None
            if before != what:
                other = next((k for k in what if before.get(k) != what[k]), "kind")
                raise ParameterError(
                    f"--out {there}: is of {other} = {before.get(other)!r}, not "
                    f"{what.get(other)!r}; name a new directory"
                )
            return
        try:
            there.mkdir(parents=True)
            file.write_text(json.dumps(what, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise ParameterError(f"--out {there}: {error.strerror}") from None

    def done(self, name: str) -> dict[str, Any] | None:
        """Result of a step; None where it is not done."""
        file = self.there / f"{name}.json"
        try:
            return Result(file, json.loads(file.read_text(encoding="utf-8")))
        except OSError:
            return None
        except ValueError:
            raise ParameterError(
                f"{file}: is no JSON object; remove it to do this step again"
            ) from None

    def keep(self, name: str, found: dict[str, object]) -> dict[str, Any]:
        """Keep the result of a step."""
        with open(self.there / f"{name}.json", "x", encoding="utf-8") as file:
            file.write(json.dumps(found, indent=1) + "\n")
        return found

    def place(self, name: str) -> Path:
        """A new directory for a run."""
        path, number = self.there / name, 1
        while path.exists():
            number += 1
            path = self.there / f"{name}-{number}"
        return path

    def measured(
        self,
        name: str,
        measurement: PlannedMeasurement,
        mode: str,
        progress: Callable[[int], None],
        **options: object,
    ) -> dict[str, Any]:
        """Figures of a measurement: those kept, or of a run made now."""
        if (found := self.done(name)) is not None:
            return found
        _, found = carry_out(measurement, mode, self.place(name), progress, **options)
        return self.keep(name, found)
