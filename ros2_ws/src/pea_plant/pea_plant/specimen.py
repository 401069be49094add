"""What lies on a simulated stage: a sample signal at each position, by a formula or a picture.

A formula has x and y in um, numbers, + - * / ** and functions of numpy; a picture covers an area.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pea_core.axes import per_axis
from pea_core.config import PICTURES
from pea_core.params import ParameterError

Specimen = Callable[[Any, Any], Any]
"""The signal at x, y (m)."""

FUNCTIONS = {
    name: getattr(np, name)
    for name in ("abs", "cos", "exp", "floor", "hypot", "log", "sin", "sqrt", "tan", "where")
}
NAMES = {"pi": math.pi}
ALLOWED = (
    *(ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant),
    *(ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Mod, ast.Pow, ast.USub, ast.UAdd),
    *(ast.Compare, ast.Lt, ast.LtE, ast.Gt, ast.GtE),
)
LONGEST = 500
"""Characters of a formula."""
SIZE_MAX = 64_000_000
"""Bytes of a picture's file, which goes with each recording."""


def image(path: Path, where: str) -> np.ndarray:
    """Grey values, 0 to 1, of a picture; numbers as they are from a NumPy file.

    Parameters
    ----------
    path : Path
    where : str
        What named it, for errors.

    Raises
    ------
    ParameterError
        It cannot be read as a picture.
    """
    from PIL import Image, UnidentifiedImageError  # slow to import

    try:
        if path.stat().st_size > SIZE_MAX:
            raise ParameterError(
                f"{where}: has {path.stat().st_size / 1e6:.0f} MB, and a recording keeps at most "
                f"{SIZE_MAX / 1e6:.0f}; give a smaller picture"
            )
        if path.suffix.lower() == ".npy":
            values = np.asarray(np.load(path, allow_pickle=False), dtype=float)
            if values.ndim != 2 or not values.size or not np.isfinite(values).all():
                raise ParameterError(
                    f"{where}: has shape {values.shape}; give a table of finite numbers"
                )
            return values
        with Image.open(path) as opened:
            return np.asarray(opened.convert("F"), dtype=float) / 255.0
    except OSError as error:
        rule = "is no picture" if isinstance(error, UnidentifiedImageError) else error.strerror
        raise ParameterError(f"{where}: {rule or error}; give a PNG, JPEG, TIFF or .npy") from None
    except (ValueError, TypeError, EOFError, Image.DecompressionBombError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"{where}: cannot be read; give a PNG, JPEG, TIFF or .npy") from None


def sampled(
    picture: np.ndarray, middle: Sequence[float], sides: Sequence[float], x: Any, y: Any
) -> Any:
    """Values of a picture that covers an area (m), at positions (m), between pixels linearly.

    The first row lies where y is least. Beyond the area the edge counts.
    """
    rows, columns = picture.shape
    i, down = _pixel(y, middle[1], sides[1], rows)
    j, right = _pixel(x, middle[0], sides[0], columns)
    below, beside = np.minimum(i + 1, rows - 1), np.minimum(j + 1, columns - 1)
    left = picture[i, j] * (1.0 - down) + picture[below, j] * down
    other = picture[i, beside] * (1.0 - down) + picture[below, beside] * down
    return left * (1.0 - right) + other * right


def _pixel(position: Any, middle: float, side: float, count: int) -> tuple[Any, Any]:
    """Pixel before a position (m), and the share of the way to the next one."""
    place = np.clip(((position - middle) / side + 0.5) * count - 0.5, 0.0, count - 1.0)
    first = np.floor(place).astype(int)
    return first, place - first


def specimen(text: str, area: Sequence[float]) -> Specimen:
    """The specimen that a formula or the path of a picture stands for.

    Parameters
    ----------
    text : str
    area : sequence of float
        What a picture covers: x and y of its middle, width, height (um).

    Raises
    ------
    ParameterError
        It is neither, or the area of a picture is missing.
    """
    if text.lower().endswith(PICTURES):
        if len(area) != 4 or min(area[2:]) <= 0.0:
            raise ParameterError(
                f"specimen_um = {list(area)}: give what the picture covers: x, y of its middle, "
                "width, height, in um"
            )
        picture = image(Path(text), f"specimen = {text!r}")
        x, y, width, height = (1e-6 * value for value in area)
        return lambda at_x, at_y: sampled(picture, (x, y), (width, height), at_x, at_y)
    code = _formula(text)

    def signal(at_x: Any, at_y: Any) -> Any:
        names = {**FUNCTIONS, **NAMES, "x": at_x * 1e6, "y": at_y * 1e6}
        with np.errstate(all="ignore"):
            value = eval(code, {"__builtins__": {}}, names)
        return value + 0.0 * at_x  # of a constant, too, one value a position

    return signal


def _formula(text: str) -> Any:
    """A formula, compiled.

    Raises
    ------
    ParameterError
        It is none.
    """
    said = f"specimen = {text!r}"
    rule = f"give a formula of x and y in um, or a picture ({', '.join(PICTURES)})"
    try:
        if len(text) > LONGEST:
            raise ValueError
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise ParameterError(f"{said}: is no formula; {rule}") from None
    known = {*FUNCTIONS, *NAMES, "x", "y"}
    for part in ast.walk(tree):
        if isinstance(part, ast.Name) and part.id not in known:
            raise ParameterError(f"{said}: no {part.id!r}; it has {', '.join(sorted(known))}")
        if not isinstance(part, ALLOWED):
            raise ParameterError(f"{said}: {rule}")
        if isinstance(part, ast.Constant):
            value = part.value
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ParameterError(f"{said}: {value!r} is no number; {rule}")
            part.value = float(value)  # powers of integers have no end
        if isinstance(part, ast.Call) and (
            part.keywords or not isinstance(part.func, ast.Name) or part.func.id not in FUNCTIONS
        ):
            raise ParameterError(f"{said}: {rule}")
    code = compile(tree, "<specimen>", "eval")
    names = {**FUNCTIONS, **NAMES, "x": np.zeros(1), "y": np.zeros(1)}
    try:
        with np.errstate(all="ignore"):
            np.asarray(eval(code, {"__builtins__": {}}, names), dtype=float)
    except Exception:
        raise ParameterError(f"{said}: cannot be computed; {rule}") from None
    return code


def of(plants: Sequence[Any]) -> Specimen | None:
    """The specimen of a plant's parameters, one an axis; None without.

    Raises
    ------
    ParameterError
        As `specimen`; the name is that of the parameter.
    """
    stage = plants[0].stage
    if not stage.specimen:
        return None
    try:
        return specimen(stage.specimen, stage.specimen_um)
    except ParameterError as error:
        raise ParameterError(f"stage.{error}") from None


class Detecting:
    """A simulated stage as a driver that has a sample signal; all else is the stage's own.

    Parameters
    ----------
    driver : driver
        Of the stage.
    stage : Simulated or Stage
    signal : callable
        What lies on it.

    Attributes
    ----------
    signal : float
        Where the stage truly was at the last sample.
    """

    def __init__(self, driver: Any, stage: Any, signal: Specimen) -> None:
        self._driver, self._stage, self._specimen = driver, stage, signal
        self.signal = math.nan

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def read(self) -> Any:
        """Measure, and look at what lies there."""
        measured = self._driver.read()
        self.signal = seen(self._specimen, self._stage)
        return measured

    def exchange(self, u: Any) -> Any:
        """Measure, then apply the command u (V) and go on to the next sample."""
        measured = self.read()
        self._stage.write(u)
        return measured


def seen(signal: Specimen, stage: Any) -> float:
    """The signal where a simulated stage truly is at this sample."""
    return float(at(signal, [true.x1 for true in per_axis(stage.truth)]))


def at(signal: Specimen, positions: Sequence[Any]) -> Any:
    """The signal at the positions of the axes (m): the first is x, the second y, if any."""
    x = np.asarray(positions[0], dtype=float)
    y = np.asarray(positions[1], dtype=float) if len(positions) > 1 else 0.0 * x
    there = np.isfinite(x) & np.isfinite(y)
    return np.where(there, signal(np.where(there, x, 0.0), np.where(there, y, 0.0)), np.nan)
