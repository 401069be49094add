"""Pictures: what a stage has made of a scan, gridded from its measured position.

A raster is gridded by line and pixel, forward and backward apart: each pixel is the mean of the
samples between its event and the next. Other scans are gridded by the position that was wanted.
The grey value is the sample signal that was recorded with each sample; or a picture, sampled at the
measured position: the picture that the scan would take.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core.params import ParameterError
from pea_core.units import NM_PER_M
from pea_plant.specimen import image as image_of
from pea_plant.specimen import sampled as sampled_at
from pea_record.read import load_axes
from pea_reference.model.scan import PIXEL, POINT
from pea_report.recorded import axes_experiment_of

DIRECTIONS = ("forward", "backward")

FILES = (".png", ".svg", ".npz", ".h5")
"""Endings of what a picture is written to."""

BINS_MAX = 8192
"""Most pixels of a side."""


class Area(NamedTuple):
    """The area of a scan: its middle and its sides (m), by axis x (along a line) and y."""

    middle: tuple[float, float]
    sides: tuple[float, float]


class Maps(NamedTuple):
    """Means of pixels (m), each (pictures, lines, pixels); NaN where a pixel has no sample.

    Attributes
    ----------
    names : tuple of str
        What each picture is: ``frame 0 forward``.
    x, y : array
        Measured position.
    w_x, w_y : array
        Position that was wanted.
    grey : array or None
        Sample signal, recorded or of a picture, where there is one.
    area : Area
    """

    names: tuple[str, ...]
    x: np.ndarray
    y: np.ndarray
    w_x: np.ndarray
    w_y: np.ndarray
    grey: np.ndarray | None
    area: Area

    @property
    def error_x(self) -> np.ndarray:
        """Measured less wanted (nm)."""
        error: np.ndarray = (self.x - self.w_x) * NM_PER_M
        return error

    @property
    def error_y(self) -> np.ndarray:
        """Measured less wanted (nm)."""
        error: np.ndarray = (self.y - self.w_y) * NM_PER_M
        return error

    @property
    def error(self) -> np.ndarray:
        """Distance of the measured position from the wanted one (nm)."""
        size: np.ndarray = np.hypot(self.error_x, self.error_y)
        return size


def rms(values: np.ndarray) -> float:
    """Root of the mean square of the pixels that have samples; NaN without any."""
    there = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(there**2))) if there.size else float("nan")


def figures(maps: Maps) -> dict[str, dict[str, float]]:
    """Rms and largest error (nm) of each picture, by x, y and distance."""
    found = {}
    for i, name in enumerate(maps.names):
        errors = {"x": maps.error_x[i], "y": maps.error_y[i], "distance": maps.error[i]}
        found[name] = {f"rms_error_{axis}_nm": rms(values) for axis, values in errors.items()}
        distance = errors["distance"]
        found[name]["max_error_nm"] = float(np.nanmax(distance, initial=0.0))
    return found


def image(path: Path) -> np.ndarray:
    """Grey values of a picture for ``--signal``; errors as `pea_plant.specimen.image`."""
    return image_of(path, f"--signal {path}")


def sampled(picture: np.ndarray, area: Area, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values of a picture that covers an area, see `pea_plant.specimen.sampled`."""
    found: np.ndarray = sampled_at(picture, area.middle, area.sides, x, y)
    return found


def raster(
    samples: np.ndarray,
    number: np.ndarray,
    events: np.ndarray,
    shape: tuple[int, int],
    area: Area,
    picture: np.ndarray | None = None,
) -> Maps:
    """Grid a raster by line and pixel.

    Parameters
    ----------
    samples : (n, 2) array of `pea_core.signals.SAMPLE`
        Of the line axis and of the frame axis.
    number : (n,) array of int
        Sample number of each, rising; gaps are allowed.
    events : array of `pea_reference.model.scan.EVENT`
        Of these samples.
    shape : (int, int)
        Lines and pixels of a frame.
    area : Area
    picture : (rows, columns) array, or (n,), optional
        Picture that is sampled at the measured position; or the signal of each sample.

    Raises
    ------
    ParameterError
        The recording holds no pixel.
    """
    pixels = events[events["kind"] == PIXEL]
    nothing = ParameterError("the recording holds no pixel of the raster: run it for longer")
    if not pixels.size:
        raise nothing
    following = np.append(pixels["k"][1:], 0)
    same = np.append(
        (pixels["line"][1:] == pixels["line"][:-1])
        & (pixels["direction"][1:] == pixels["direction"][:-1])
        & (pixels["frame"][1:] == pixels["frame"][:-1]),
        False,
    )
    steps = (following - pixels["k"])[same]
    usual = max(int(np.median(steps)), 1) if steps.size else 1
    end = np.where(same, following, pixels["k"] + usual)
    starts, ends = np.searchsorted(number, pixels["k"]), np.searchsorted(number, end)
    kept = ends > starts
    pixels, starts, ends = pixels[kept], starts[kept], ends[kept]
    if not pixels.size:
        raise nothing
    frames, which = np.unique(pixels["frame"], return_inverse=True)
    back = (pixels["direction"] < 0).astype(int)
    place = (2 * which + back, pixels["line"], pixels["pixel"])
    columns = _columns(samples, area, picture)
    maps = []
    for column in columns:
        means = np.full((2 * frames.size, *shape), np.nan)
        bounds = np.column_stack([starts, ends]).ravel()
        sums = np.add.reduceat(np.append(column, 0.0), bounds)[::2]
        means[place] = sums / (ends - starts)
        maps.append(means)
    names = tuple(f"frame {frame} {way}" for frame in frames for way in DIRECTIONS)
    there = [bool(np.isfinite(maps[0][i]).any()) for i in range(len(names))]
    names = tuple(name for name, has in zip(names, there, strict=True) if has)
    maps = [each[there] for each in maps]
    return _maps(names, maps, area)


def _columns(samples: np.ndarray, area: Area, picture: np.ndarray | None) -> list[np.ndarray]:
    """Measured and wanted x and y of each sample (m), and the signal there."""
    columns = [samples[name][:, axis] for name in ("y", "w") for axis in (0, 1)]
    if picture is not None:
        told = picture if picture.ndim == 1 else sampled(picture, area, columns[0], columns[1])
        columns.append(told)
    return columns


def _maps(names: tuple[str, ...], maps: Sequence[np.ndarray], area: Area) -> Maps:
    """Maps in the order of `_columns`."""
    x, y, w_x, w_y = maps[:4]
    return Maps(names, x, y, w_x, w_y, maps[4] if len(maps) > 4 else None, area)


def binned(samples: np.ndarray, bins: int, area: Area, picture: np.ndarray | None = None) -> Maps:
    """Grid any scan of two axes by the position that was wanted, into bins x bins pixels.

    Parameters
    ----------
    samples : (n, 2) array of `pea_core.signals.SAMPLE`
        Of x and of y.
    bins : int
        Pixels of a side.
    area, picture
        As of `raster`.
    """
    columns = _columns(samples, area, picture)
    places = []
    for axis in (0, 1):
        share = (columns[2 + axis] - area.middle[axis]) / area.sides[axis] + 0.5
        places.append(np.floor(share * bins).astype(int))
    inside = np.all([(place >= 0) & (place < bins) for place in places], axis=0)
    flat = (places[1] * bins + places[0])[inside]
    count = np.bincount(flat, minlength=bins * bins)
    maps = []
    for column in columns:
        sums = np.bincount(flat, weights=column[inside], minlength=bins * bins)
        with np.errstate(invalid="ignore"):
            maps.append((sums / count).reshape(1, bins, bins))
    return _maps(("all samples",), maps, area)


class ScanRun(NamedTuple):
    """What a recording says of a scan: an experiment an axis, samples, their numbers, signal."""

    name: str
    each: tuple[Any, ...]
    samples: np.ndarray
    number: np.ndarray
    signal: np.ndarray | None


def load(path: Path) -> ScanRun:
    """Read a recording of several axes.

    Raises
    ------
    BagError, ParameterError
        It cannot be read, has one axis only, or does not say what ran.
    """
    recording = load_axes(path)
    if len(recording.axes) < 2:
        raise ParameterError(
            f"{path} has one axis, {recording.axes[0]}: a picture needs two; record a scan with "
            "axes: [x, y]"
        )
    experiment = axes_experiment_of(recording, path)
    number = recording.stamps // experiment.T_ns
    each, samples = experiment.each, recording.samples
    return ScanRun(experiment.name, each, samples, number, recording.signal)


def free(bag: Path) -> Path:
    """A new name for a picture of a recording."""
    there = bag if bag.is_dir() else bag.parent
    names = ("image.png", *(f"image-{i}.png" for i in range(1, 10_000)))
    return next(there / name for name in names if not (there / name).exists())


def check(path: Path) -> None:
    """Refuse a file that cannot be written, before anything is read.

    Raises
    ------
    ParameterError
        Of another ending, there already, or in no directory.
    """
    if path.suffix not in FILES:
        raise ParameterError(f"--out {path}: must end in {', '.join(FILES)}")
    if path.exists():
        raise ParameterError(f"--out {path}: exists already; nothing is written over")
    if not path.parent.is_dir():
        raise ParameterError(f"--out {path}: no such directory; make it first")


def reached(run: ScanRun, tolerance: float) -> list[dict[str, Any]]:
    """When each point of a list was reached, see `on_target`; a row each.

    Raises
    ------
    ParameterError
        The scan is no list of points.
    """
    follow = [one for one in run.each if one.scan_events is not None]
    found: list[OnTarget] = []
    if follow:
        events = follow[0].scan_events(int(run.number[0]), int(run.number[-1]) + 1)
        found = on_target(run.samples, run.number, events, tolerance)
    if not found:
        raise ParameterError("--tolerance: the scan reaches no point of a list; omit it")
    T_s = run.each[0].T_s
    return [
        {
            "round": row.frame,
            "point": row.point,
            "planned_s": row.planned * T_s,
            "after_s": None if row.reached is None else (row.reached - row.planned) * T_s,
        }
        for row in found
    ]


PARTS = (("line", "x"), ("frame", "y"))
"""Parts of a scan along a line of a picture, and across."""


def of_run(
    each: Sequence[Any],
    samples: np.ndarray,
    number: np.ndarray,
    bins: int = 128,
    picture: np.ndarray | None = None,
) -> Maps:
    """Maps of a run of several axes.

    Parameters
    ----------
    each : sequence of Experiment
        One an axis.
    samples : (n, axes) array of `pea_core.signals.SAMPLE`
    number : (n,) array of int
        Sample number of each, rising.
    bins : int
        Pixels of a side, where the scan is no raster.
    picture
        As of `raster`.

    Raises
    ------
    ParameterError
        No two axes follow a scan, or it has no pixel yet.
    """
    followed = [one.nodes["reference"].params for one in each]
    places = [_place(followed, names) for names in PARTS]
    if None in places and _of_points(each):
        places = [0, 1]
    if samples.ndim < 2 or None in places:
        raise ParameterError(
            "the recording has no two axes that follow a scan: give the reference of one "
            "part = 'line' and of the other 'frame', or 'x' and 'y'"
        )
    x, y = (int(place) for place in places if place is not None)
    own = samples[:, [x, y]]
    params = followed[x], followed[y]
    events = each[x].scan_events
    if events is not None and params[0].part == "line":
        area = Area(
            (params[0].offset_um * 1e-6, params[1].offset_um * 1e-6), _sides(params[0], own)
        )
        found = events(int(number[0]), int(number[-1]) + 1)
        return raster(own, number, found, (params[0].lines, params[0].pixels), area, picture)
    middle = tuple(0.5 * float(w.min() + w.max()) for w in (own["w"][:, 0], own["w"][:, 1]))
    return binned(own, bins, Area((middle[0], middle[1]), _sides(None, own)), picture)


def _of_points(each: Sequence[Any]) -> bool:
    """Whether the first two axes follow a list of points, whose columns may have any name."""
    followed = [one.nodes["reference"].params for one in each[:2]]
    return all(hasattr(params, "part") and hasattr(params, "repeat") for params in followed)


def _sides(params: Any, samples: np.ndarray) -> tuple[float, float]:
    """Sides of the area (m): of a raster, its own; else what w covers."""
    if params is not None:
        return params.width_um * 1e-6, params.height_um * 1e-6
    spans = [float(np.ptp(samples["w"][:, axis])) or 1e-9 for axis in (0, 1)]
    return spans[0] * (1.0 + 1e-9), spans[1] * (1.0 + 1e-9)


def _place(followed: Sequence[Any], names: Sequence[str]) -> int | None:
    """First axis whose part of a scan has one of some names."""
    parts = [getattr(params, "part", None) for params in followed]
    return next((i for i, part in enumerate(parts) if part in names), None)


class OnTarget(NamedTuple):
    """A point of a list: the sample at which it is planned, and at which all axes are there."""

    point: int
    frame: int
    planned: int
    reached: int | None


def on_target(
    samples: np.ndarray, number: np.ndarray, events: np.ndarray, tolerance: float
) -> list[OnTarget]:
    """When each point is reached: from then on all axes stay within a tolerance until w leaves.

    Parameters
    ----------
    samples : (n, axes) array of `pea_core.signals.SAMPLE`
    number : (n,) array of int
        Sample number of each, rising.
    events : array of `pea_reference.model.scan.EVENT`
    tolerance : float
        Of each axis (m).
    """
    found = []
    for event in events[events["kind"] == POINT]:
        begin = int(np.searchsorted(number, event["k"]))
        if begin >= len(number):
            continue
        rest = samples[begin:]
        moved = np.any(rest["w"] != rest["w"][0], axis=1)
        stay = int(np.argmax(moved)) if moved.any() else len(rest)
        off = np.flatnonzero(
            np.any(np.abs(rest["y"][:stay] - rest["w"][:stay]) > tolerance, axis=1)
        )
        after = int(off[-1]) + 1 if off.size else 0
        reached = int(number[begin + after]) if after < stay else None
        found.append(OnTarget(int(event["pixel"]), int(event["frame"]), int(event["k"]), reached))
    return found


def arrays(maps: Maps) -> dict[str, np.ndarray]:
    """What a file of numbers holds, each with its unit in the name."""
    found = {
        "x_um": maps.x * 1e6,
        "y_um": maps.y * 1e6,
        "w_x_um": maps.w_x * 1e6,
        "w_y_um": maps.w_y * 1e6,
        "error_x_nm": maps.error_x,
        "error_y_nm": maps.error_y,
        "error_nm": maps.error,
    }
    return found if maps.grey is None else {**found, "signal": maps.grey}


def write(path: Path, maps: Maps, title: str = "") -> None:
    """Write a new file: a figure (.png, .svg), or the numbers (.npz, .h5).

    Raises
    ------
    ParameterError
        Of another ending, or there already.
    """
    if path.suffix not in FILES:
        raise ParameterError(f"{path}: must end in {', '.join(FILES)}")
    try:
        if path.suffix in (".png", ".svg"):
            from pea_lab.plot import save_as

            save_as(figure(maps, title), path)
        elif path.suffix == ".npz":
            with open(path, "xb") as file:
                np.savez_compressed(file, names=np.array(maps.names), **arrays(maps))  # type: ignore[arg-type]
        else:
            _hdf5(path, maps)
    except FileExistsError:
        raise ParameterError(f"{path}: exists already; nothing is written over") from None


def _hdf5(path: Path, maps: Maps) -> None:
    import h5py  # slow to import

    with h5py.File(path, "x") as file:
        file["names"] = list(maps.names)
        for name, values in arrays(maps).items():
            file.create_dataset(name, data=values, compression="gzip")
        file.attrs["middle_um"] = [value * 1e6 for value in maps.area.middle]
        file.attrs["sides_um"] = [value * 1e6 for value in maps.area.sides]


def figure(maps: Maps, title: str = "") -> Any:
    """The last whole frame: maps of the error in x, in y and of its size, and the signal."""
    from pea_lab.plot import TITLE_MAX, plt

    last = _shown(maps)
    panels: list[tuple[str, str, Mapping[int, np.ndarray]]] = [
        (name, cmap, dict(enumerate(values)))
        for name, cmap, values in (
            ("error in x (nm)", "RdBu_r", maps.error_x),
            ("error in y (nm)", "RdBu_r", maps.error_y),
            ("size of the error (nm)", "viridis", maps.error),
            *(() if maps.grey is None else (("signal", "gray", maps.grey),)),
        )
    ]
    plot, axes = plt.subplots(
        len(last), len(panels), squeeze=False, layout="constrained",
        figsize=(3.4 * len(panels), 3.1 * len(last) + 0.3),
    )  # fmt: skip
    low = [(m - 0.5 * s) * 1e6 for m, s in zip(maps.area.middle, maps.area.sides, strict=True)]
    high = [(m + 0.5 * s) * 1e6 for m, s in zip(maps.area.middle, maps.area.sides, strict=True)]
    for column, (name, cmap, values) in enumerate(panels):
        shown = np.array([values[i] for i in last])
        limits = _limits(shown, cmap)
        for row, i in enumerate(last):
            ax = axes[row, column]
            drawn = ax.imshow(
                values[i], origin="lower", cmap=cmap, vmin=limits[0], vmax=limits[1],
                extent=(low[0], high[0], low[1], high[1]), interpolation="nearest",
            )  # fmt: skip
            ax.set_title(f"{name}\n{maps.names[i]}", fontsize=9)
            ax.set_xlabel("x (µm)")
            ax.set_ylabel("y (µm)")
            plot.colorbar(drawn, ax=ax, shrink=0.8)
    plot.suptitle(title[:TITLE_MAX])
    return plot


def _shown(maps: Maps) -> list[int]:
    """Pictures of the last frame that is as complete as any."""
    frames: dict[str, list[int]] = {}
    for i, name in enumerate(maps.names):
        frames.setdefault(" ".join(name.split()[:2]), []).append(i)
    full = {n: int(np.isfinite(maps.x[places]).sum()) for n, places in frames.items()}
    return frames[max(reversed(full), key=lambda name: full[name])]


def _limits(values: np.ndarray, cmap: str) -> tuple[float | None, float | None]:
    """Range of colours, that of 99 % of the pixels; symmetric about 0 for signed errors."""
    there = values[np.isfinite(values)]
    if not there.size:
        return None, None
    if cmap == "gray":
        return float(there.min()), float(there.max())
    most = float(np.quantile(np.abs(there), 0.99)) or 1.0
    return (-most if cmap == "RdBu_r" else 0.0), most


def lines_of(maps: Maps) -> Sequence[tuple[str, float, float, float, float]]:
    """A row for each picture: rms in x, in y, of the distance, and the largest distance (nm)."""
    rows = []
    for name, row in figures(maps).items():
        x, y, distance, most = row.values()
        rows.append((name, x, y, distance, most))
    return rows
