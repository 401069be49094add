"""Records from files of others: CSV, MATLAB (v5 and v7.3), HDF5, TDMS, NumPy.

Nothing is guessed: a column, its unit and the sample period come from the file or from whoever
asks, and `Found.understood` says in one line how a file was read. A name gives its unit as in
``u [V]``, ``y (um)``, ``y_um``, ``t / ms``; a file gives its rate by a column of time, or by a
number called ``fs`` (Hz) or ``T_s``, ``Ts``, ``dt`` (s). A column ``u_applied`` is what `pea`
records: the voltage of the interval that ended at the stamp; any other voltage counts from its
sample on.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pea_core.params import ParameterError, nearest
from pea_core.tables import LENGTH, TIME, TIMES, VOLTAGE, Quantity
from pea_identify.records import Record, record

ENDINGS = (".csv", ".txt", ".dat", ".tsv", ".mat", ".h5", ".hdf5", ".hdf", ".tdms", ".npz", ".npy")
"""File names that are read here."""

VOLTAGES = ("u_applied", "u", "voltage", "input", "v_in", "volt")
"""Names of a voltage, the preferred first."""

LENGTHS = ("y", "displacement", "position", "output", "x", "x1", "pos")
"""Names of a displacement, the preferred first."""

RATES = ("fs", "f_s", "rate", "sample_rate")
PERIODS = ("t_s", "ts", "dt", "sample_period")
"""Names of a rate (Hz) and of a sample period (s)."""

_UNIT = re.compile(r"^(.*?)\s*(?:[\[(]\s*([^\])]*?)\s*[\])]|/\s*(\S+)|_([A-Za-zµμ]+))?\s*$")


class Asked(NamedTuple):
    """What the caller states about a file; empty or 0 where it states nothing.

    Attributes
    ----------
    u, y, time : str
        ``NAME``, ``NAME:UNIT`` or ``:UNIT``; NAME may be a number of a column, from 1. Several
        names of u or y, separated by commas, are several axes.
    rate : float
        Samples a second.
    kind : str
        See `pea_identify.records.KINDS`.
    period : int
        Samples a period.
    """

    u: str = ""
    y: str = ""
    time: str = ""
    rate: float = 0.0
    kind: str = ""
    period: int = 0


NOTHING = Asked()


class Found(NamedTuple):
    """Records of one file, and how it was read.

    Attributes
    ----------
    records : list of Record
    understood : str
        One line.
    """

    records: list[Record]
    understood: str


class FileColumn(NamedTuple):
    """One array of a file: its name without unit, its unit (or empty), and the values."""

    name: str
    unit: str
    values: np.ndarray
    text: str


def read(path: Path, asked: Asked = NOTHING) -> Found:
    """Read a file.

    Raises
    ------
    ParameterError
        It cannot be read, or a column, a unit or the rate is missing, or has two meanings.
    """
    if not path.exists():
        raise ParameterError(f"{path}: no such file")
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ParameterError(
            f"{path}: unknown kind of file: must end in one of {', '.join(ENDINGS)}, or be a "
            "recording"
        )
    try:
        if ending in (".mat", ".h5", ".hdf5", ".hdf"):
            arrays = _matlab(path) if ending == ".mat" else _hdf5(path)
        elif ending == ".tdms":
            arrays = _tdms(path)
        elif ending in (".npz", ".npy"):
            arrays = _numpy(path)
        else:
            arrays = _text(path)
    except (OSError, ValueError, KeyError, TypeError, NotImplementedError, EOFError) as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ParameterError(f"{path.name}: cannot be read: {said[:120]}") from None
    return of_arrays(arrays, asked, path.name)


def of_arrays(arrays: dict[str, object], asked: Asked, name: str) -> Found:
    """Records of named arrays, as a file holds them."""
    columns = [_column(text, values) for text, values in arrays.items()]
    us = _wanted(columns, asked.u, VOLTAGES, VOLTAGE, "u", name)
    ys = _wanted(columns, asked.y, LENGTHS, LENGTH, "y", name)
    u, scale_u = _values(us, VOLTAGE, asked.u, "--u", name)
    y, scale_y = _values(ys, LENGTH, asked.y, "--y", name)
    y = y * 1e-6  # the quantity's own unit is um
    T_s, source = _period(columns, asked, len(u), name)
    of_us, of_ys = ", ".join(c.name for c in us), ", ".join(c.name for c in ys)
    said = f"{name}: u from {of_us} in {scale_u}, y from {of_ys} in {scale_y}, {source}"
    if us[0].name == "u_applied" and u.ndim == 2:
        u, y = u[1:], y[:-1]
        said += "; u_applied is of the interval before its stamp"
    if u.ndim == 4 or y.ndim == 4:
        return Found(
            _periods(u, y, T_s, name), f"{said}; {u.shape[2]} realisations of whole periods"
        )
    made = record(u, y, T_s, name, asked.kind, asked.period)
    kind = f"{made.kind}, period {made.period} samples" if made.period else made.kind
    return Found([made], f"{said}; {len(u)} samples, {kind}")


def _periods(u: np.ndarray, y: np.ndarray, T_s: float, name: str) -> list[Record]:
    """A record for each realisation of (N, n, R, P) arrays."""
    if u.ndim != 4 or y.ndim != 4 or (u.shape[0], *u.shape[2:]) != (y.shape[0], *y.shape[2:]):
        raise ParameterError(
            f"{name}: u is {u.shape} and y {y.shape}: give both as (samples, channels, "
            "realisations, periods)"
        )
    made = []
    N, _, R, P = u.shape
    for i in range(R):
        rows = [np.concatenate([a[:, :, i, p] for p in range(P)]) for a in (u, y)]
        kind = "periodic" if P > 1 else "general"
        made.append(record(rows[0], rows[1], T_s, f"{name}, realisation {i}", kind, N * (P > 1)))
    return made


def _column(text: str, values: object) -> FileColumn:
    """A column whose unit is split from its name where it has one."""
    found = _UNIT.match(text.strip())
    name, unit = text.strip(), ""
    if found:
        given = found[2] or found[3] or found[4] or ""
        known = any(q.scale(given) is not None for q in (VOLTAGE, LENGTH, TIME)) if given else False
        marked = found[2] is not None or found[3] is not None
        if given and (marked or (known and found[1].lower() not in ("t", "x"))):
            name, unit = found[1].strip(), given
        if given and not marked and text.strip().lower() in (*PERIODS, *RATES, *VOLTAGES):
            name, unit = text.strip(), ""
    try:
        values = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.size > 1 and name.lower() == "t_s":  # not one sample period but the times, in s
        name, unit = "t", "s"
    return FileColumn(name, unit, values, text.strip())


def _split(asked: str) -> tuple[list[str], str]:
    """Names and unit of an option ``NAME,NAME:UNIT``."""
    names, _, unit = asked.rpartition(":") if ":" in asked else (asked, "", "")
    return [name.strip() for name in names.split(",") if name.strip()], unit.strip()


def _wanted(
    columns: Sequence[FileColumn],
    asked: str,
    known: tuple[str, ...],
    quantity: Quantity,
    what: str,
    name: str,
) -> list[FileColumn]:
    """The columns of a quantity, by the names asked for, or else by known names."""
    wanted, _ = _split(asked)
    held = [c for c in columns if c.values.size > 1]
    by_name = {c.name.lower(): c for c in held} | {c.text.lower(): c for c in held}
    if wanted:
        found = []
        for each in wanted:
            if each.lower() in by_name:
                found.append(by_name[each.lower()])
            elif each.isdigit() and 1 <= int(each) <= len(columns):
                found.append(columns[int(each) - 1])
            else:
                advice = nearest(each, [c.name for c in held])
                raise ParameterError(f"{name}: no column {each!r} for {what}: {advice}")
        return found
    for each in known:
        same = [c for c in held if c.name.lower() == each]
        if len(same) == 1:
            return same
        if len(same) > 1:
            raise ParameterError(f"{name}: {len(same)} columns {each!r}: name one with --{what}")
        numbered = [c for c in held if re.fullmatch(rf"{each}_?\d+", c.name.lower())]
        if numbered:
            return numbered
    names = ", ".join(c.name for c in held[:8]) or "none"
    raise ParameterError(
        f"{name}: which column is {what} ({quantity.unit})? It has {names}: name it with "
        f"--{what} NAME:UNIT"
    )


def _values(
    columns: Sequence[FileColumn], quantity: Quantity, asked: str, option: str, name: str
) -> tuple[np.ndarray, str]:
    """Values of columns in the quantity's unit, and the unit that they had."""
    _, given = _split(asked)
    parts = []
    for c in columns:
        unit = given or c.unit
        if not unit:
            raise ParameterError(
                f"{name}: unit of {c.name} is not given: write {option} {c.name}:UNIT, for "
                f"example {c.name}:{quantity.unit}"
            )
        scale = quantity.scale(unit)
        if scale is None:
            known = ", ".join(list(quantity.units)[:4])
            raise ParameterError(f"{name}: {unit!r} is no unit of {c.name}: use {known}")
        values = np.squeeze(c.values) if c.values.ndim < 3 else c.values
        if values.ndim == 2 and values.shape[0] < values.shape[1]:
            values = values.T
        parts.append((values if values.ndim > 1 else values[:, None]) * float(scale))
    if len({len(p) for p in parts}) > 1:
        raise ParameterError(f"{name}: columns of {option} have different lengths")
    return (parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)), unit


def _period(
    columns: Sequence[FileColumn], asked: Asked, samples: int, name: str
) -> tuple[float, str]:
    """Sample period (s), and where it comes from."""
    if asked.rate:
        return 1.0 / asked.rate, f"{asked.rate:g} Hz as asked"
    for c in columns:
        if c.values.size == 1:
            value = float(c.values.ravel()[0])
            if c.name.lower() in RATES and value > 0.0:
                return 1.0 / value, f"{value:g} Hz from {c.name}"
            if c.name.lower() in PERIODS and value > 0.0:
                return value, f"{1.0 / value:g} Hz from {c.name} in s"
    wanted, given = _split(asked.time)
    times = [c for c in columns if c.values.size > 1]
    found = [c for c in times if c.name.lower() in ([w.lower() for w in wanted] or TIMES)]
    if wanted and not found and wanted[0].isdigit() and int(wanted[0]) <= len(columns):
        found = [columns[int(wanted[0]) - 1]]
    if not found:
        raise ParameterError(
            f"{name}: no column of time and no fs or T_s: give --rate HZ or --time NAME:UNIT"
        )
    c = found[0]
    unit = given or c.unit
    if not unit:
        raise ParameterError(
            f"{name}: unit of {c.name} is not given: write --time {c.name}:UNIT, for example "
            f"{c.name}:s"
        )
    scale = TIME.scale(unit)
    if scale is None:
        raise ParameterError(f"{name}: {unit!r} is no unit of time: use s, ms, us or ns")
    t = np.ravel(c.values) * float(scale)
    if len(t) != samples:
        raise ParameterError(f"{name}: {len(t)} times for {samples} samples")
    if len(t) < 2 or not np.isfinite(t).all():
        raise ParameterError(f"{name}: times that are not finite: cut them out first")
    step = float(t[-1] - t[0]) / (len(t) - 1)
    gaps = np.diff(t)
    if step <= 0.0 or not (gaps > 0.0).all():
        k = int(np.argmin(gaps))
        raise ParameterError(f"{name}: time does not rise at sample {k + 1}")
    # rounded digits of a time column may shift each time by half a digit
    worst = int(np.argmax(np.abs(gaps - step)))
    if abs(gaps[worst] - step) > 0.05 * step:
        raise ParameterError(
            f"{name}: sampled unevenly: {gaps[worst]:.6g} s at sample {worst}, {step:.6g} s on "
            "average: resample it, or cut the gap out"
        )
    return float(f"{step:.7g}"), f"{1.0 / step:.7g} Hz from {c.name} in {unit}"


def _numpy(path: Path) -> dict[str, Any]:
    try:
        loaded = np.load(path, allow_pickle=False)
    except ValueError as error:
        if "pickle" in str(error):
            raise ValueError("it holds no plain arrays of numbers") from None
        raise
    if isinstance(loaded, np.ndarray):
        if loaded.dtype.names:
            return {n: loaded[n] for n in loaded.dtype.names}
        if loaded.ndim == 2:
            rows = loaded if loaded.shape[0] >= loaded.shape[1] else loaded.T
            return {f"column {i + 1}": rows[:, i] for i in range(rows.shape[1])}
        raise ValueError(f"an array of shape {loaded.shape} has no columns")
    return {n: loaded[n] for n in loaded.files}


def _matlab(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        if (
            file.read(128).startswith(b"MATLAB 7.3")
            or path.read_bytes()[512:520] == b"\x89HDF\r\n\x1a\n"
        ):
            return _hdf5(path)
    from scipy.io import loadmat

    try:
        loaded = loadmat(path, squeeze_me=True, struct_as_record=False)
    except Exception:  # scipy raises what comes, from the bytes of whatever file
        raise ValueError("it is no MATLAB file of version 5 or 7.3") from None
    return _flat({k: v for k, v in loaded.items() if not k.startswith("__")})


def _flat(values: dict[str, object]) -> dict[str, Any]:
    """Arrays by name; those of a structure by the name of the field where that is unique."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        if hasattr(value, "_fieldnames"):
            inner = _flat({field: getattr(value, field) for field in value._fieldnames})
            for field, array in inner.items():
                out[field if field not in values and field not in out else f"{name}.{field}"] = (
                    array
                )
        else:
            out[name] = value
    return out


def _hdf5(path: Path) -> dict[str, Any]:
    import h5py

    out: dict[str, Any] = {}
    with h5py.File(path, "r") as file:

        def visit(name: str, item: object) -> None:
            if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "fiu":
                return
            values = item[()]
            if "MATLAB_class" in item.attrs and np.ndim(values) > 1:
                values = np.transpose(values)
            short = name.rpartition("/")[2]
            unit = item.attrs.get("unit", item.attrs.get("units", ""))
            unit = unit.decode() if isinstance(unit, bytes) else str(unit)
            key = short if short not in out else name
            out[f"{key} [{unit}]" if unit else key] = values

        file.visititems(visit)
        known = (*RATES, *PERIODS)
        out |= {name: value for name, value in file.attrs.items() if name.lower() in known}
    return out


def _tdms(path: Path) -> dict[str, Any]:
    """Channels with their unit; the period of a waveform."""
    from nptdms import TdmsFile

    out: dict[str, Any] = {}
    for group in TdmsFile.read(path).groups():
        for channel in group.channels():
            if channel.dtype.kind not in "fiu":
                continue
            name = channel.name if channel.name not in out else f"{group.name}.{channel.name}"
            unit = str(channel.properties.get("unit_string", ""))
            out[f"{name} [{unit}]" if unit else name] = channel[:]
            period = float(channel.properties.get("wf_increment", 0.0))
            if period > 0.0 and out.setdefault("dt", period) != period:
                raise ValueError(
                    f"channels at {out['dt']:g} s and {period:g} s; one rate is needed"
                )
    return out


def _text(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    text = ""
    for encoding in (
        ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252")
    ):
        try:
            text = data.decode(encoding)
            break
        except UnicodeDecodeError:
            continue
    lines = [line for line in text.splitlines() if line.strip(" \t,;")]
    head = ""
    rows: list[str] = []
    for line in lines:
        if rows or re.match(r"\s*[-+.\d]", line.lstrip('"')) or re.match(r"\s*nan", line, re.I):
            if not line.lstrip().startswith("#"):
                rows.append(line)
        else:
            head = line.lstrip("# \t")
    if not rows:
        raise ValueError("it has no line of numbers")
    separator = next((s for s in (";", "\t", ",") if s in rows[0]), None)
    comma = separator != "," and "," in rows[0]
    body = "\n".join(rows)
    body = body.replace(",", ".") if comma else body
    width = len(rows[0].split(separator))
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=separator, ndmin=2)
    except ValueError:
        for number, line in enumerate(rows):
            fields = line.split(separator)
            if len(fields) != width or not all(_number(f, comma) for f in fields):
                raise ValueError(
                    f"row {number + 1} is {line[:40]!r}: not {width} numbers"
                ) from None
        raise
    if table.shape[1] < 2:
        raise ValueError("one column: u and y are two")
    names = [n.strip().strip('"') for n in head.split(separator)] if head else []
    if len(names) != table.shape[1]:
        names = [f"column {i + 1}" for i in range(table.shape[1])]
    if len(set(names)) < len(names):
        raise ValueError("two columns have one name")
    return {n: table[:, i] for i, n in enumerate(names)}


def _number(field: str, comma: bool) -> bool:
    try:
        float(field.replace(",", ".") if comma else field)
    except ValueError:
        return False
    return True
