"""C made into shared libraries by the user's compiler, once, under a digest of its text."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from pea_core.params import ParameterError
from pea_core.paths import own

EXAMPLES = Path(__file__).resolve().parent / "examples"
"""Sources that come with the package."""

NATIVE, BOARD = EXAMPLES / "native", EXAMPLES / "board"

FLAGS = ("-std=c11", "-D_GNU_SOURCE", "-O2", "-Wall", "-Wextra", "-fPIC")
PATIENCE = 120.0
"""Seconds that a compiler has."""


def compiler() -> str:
    """Path of the C compiler: ``CC``, or ``cc``; empty where there is none."""
    return shutil.which(os.environ.get("CC") or "cc") or ""


def folder() -> Path:
    """Where libraries are kept, which nobody else may write to.

    Raises
    ------
    ParameterError
        There is no such place.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "pea" / "native"
    try:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError) as error:
        raise ParameterError(f"{root}: no place for compiled drivers: {error}") from None
    if not own(root):
        raise ParameterError(
            f"{root}: others can write to it, and what is there is run; make it yours"
        )
    return root


def made(
    sources: Sequence[Path], name: str, libraries: Sequence[str] = (), shared: bool = True
) -> Path:
    """Compile sources, or find what was compiled from them before.

    Parameters
    ----------
    sources : sequence of Path
    name : str
        For people.
    libraries : sequence of str
        To link with: ``comedi``.
    shared : bool
        A shared library; else a program.

    Raises
    ------
    ParameterError
        There is no compiler, or it refuses the sources; one line.
    """
    cc = compiler()
    if not cc:
        raise ParameterError(
            f"{name}: a C compiler is needed to make it; install one (Debian: gcc), or name it "
            "with CC"
        )
    places = dict.fromkeys([*(source.parent for source in sources), NATIVE, BOARD])
    headers = sorted(header for place in places for header in place.glob("*.h"))
    command = [cc, *FLAGS, *(["-shared"] if shared else [])]
    command += [f"-I{place}" for place in places]
    text = b"\0".join([repr(command + list(libraries)).encode()])
    try:
        text += b"\0".join(path.read_bytes() for path in [*sources, *headers])
    except OSError as error:
        raise ParameterError(f"{error.filename}: {error.strerror}") from None
    digest = hashlib.sha256(text).hexdigest()[:16]
    target = folder() / (f"lib{name}-{digest}.so" if shared else f"{name}-{digest}")
    if target.exists():
        return target
    with tempfile.TemporaryDirectory(dir=target.parent) as there:
        part = Path(there, target.name)
        command += ["-o", str(part), *map(str, sources), "-lm", *(f"-l{one}" for one in libraries)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ParameterError(f"{name}: {cc} does not run: {error}") from None
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if "error" in line]
            why = (errors or done.stderr.splitlines() or ["no message"])[0]
            raise ParameterError(f"{name}: {cc} refuses it: {why}")
        os.replace(part, target)
    return target
