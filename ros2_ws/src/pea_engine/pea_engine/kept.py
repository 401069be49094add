"""Kernels kept on disk, each in a file that is named by what it is.

Numba numbers its files, and an index says which is which: where two processes add to it at once,
one number is given twice, and the loop of one is then run for that of the other. Here there is no
index, and what a file is of stands in it.

It imports numba: imported where something is compiled.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, NullCache
from numba.core.serialize import dumps

from pea_core.paths import own

STALE = (ImportError, AttributeError, EOFError, ValueError, pickle.UnpicklingError)
"""What reading a kept kernel raises where it is of types that are gone, or damaged."""


class _Files:
    """The files of one function, for all types of its arguments and all that it closes over."""

    def __init__(self, directory: Path, name: str, stamp: object) -> None:
        self._directory, self._name = directory, name
        self._version = f"{name}-{_digest((numba.__version__, stamp))[:8]}"

    def _path(self, key: object) -> Path:
        return self._directory / f"{self._version}-{_digest(key)[:24]}.nbc"

    def load(self, key: object) -> Any:
        """What is kept under a key; None where nothing is."""
        try:
            of, kernel = pickle.loads(self._path(key).read_bytes())
        except OSError:
            return None
        return kernel if of == key else None

    def save(self, key: object, kernel: object) -> None:
        """Keep a kernel, whole or not at all; those of other versions of the function go."""
        path = self._path(key)
        part = path.with_suffix(f".{os.getpid()}.part")
        try:
            part.write_bytes(dumps((key, kernel)))
            part.replace(path)
        except OSError:
            part.unlink(missing_ok=True)
            raise
        for old in self._directory.glob(f"{self._name}[.-]*"):
            if not old.name.startswith(self._version):
                old.unlink(missing_ok=True)


def _digest(what: object) -> str:
    return hashlib.sha256(repr(what).encode()).hexdigest()


class Kept(FunctionCache):
    """Where numba looks for a compiled function, and leaves it."""

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        locator = self._impl.locator
        self._cache_file = _Files(
            Path(self.cache_path), self._impl.filename_base, locator.get_source_stamp()
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What is kept for the types of arguments; None where nothing of use is."""
        try:
            return super().load_overload(sig, target_context)
        except STALE:
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep it, where there is room and the right to."""
        with suppress(OSError):
            super().save_overload(sig, data)


def keeping(function: Callable[..., object]) -> Kept | NullCache:
    """Where a function is to be kept: nowhere, if there is no directory that is our own."""
    try:
        kept = Kept(function)
    except RuntimeError:
        return NullCache()
    return kept if own(Path(kept.cache_path)) else NullCache()
