"""Give very many inputs that nobody meant to everything that reads: ``make fuzz``.

    .ci/env python tests/fuzz/run.py [TARGET …] [--inputs N] [--seed S] [--jobs N]
    .ci/env python tests/fuzz/run.py --again FILE       # one that was kept

Targets are the modules beside this file, see `__init__.py`. Each worker is a process that takes a
share of one target's inputs; one that dies, or hangs beyond what a signal ends, is replaced. An
input at fault is kept in ``runs/fuzz-<time>/`` with what it did. Exit status: 0 none, 1 some.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import itertools
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
PACKAGE = "pea_fuzz"
"""Name under which this folder is imported: its files may be called as they like."""

INPUTS = 100_000
LIMIT = 10.0
"""Seconds that an input may take."""

BATCH = 500
"""Inputs of one seed: a worker takes so many of a target, then of the next one."""

GRACE = 6.0
"""Times the limit after which a worker is killed: no signal ends what it does."""

MEMORY = 8 << 30
"""Bytes of address space of a worker."""

KEPT_MAX = 20
"""Faults that are kept of a target; more are counted."""

_DONE = struct.Struct("<QQ")


class Hang(BaseException):
    """An input that takes too long."""


class Fault(NamedTuple):
    """An input that did what no input may do."""

    target: str
    data: bytes
    words: str


def package() -> None:
    """Make this folder a package, wherever Python looks for others."""
    if PACKAGE not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            PACKAGE, HERE / "__init__.py", submodule_search_locations=[str(HERE)]
        )
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[PACKAGE] = module
        spec.loader.exec_module(module)


def names() -> list[str]:
    """Names of the targets."""
    return sorted(p.stem for p in HERE.glob("*.py") if p.stem not in ("__init__", "run"))


def target(name: str) -> ModuleType:
    """A target's module."""
    package()
    return importlib.import_module(f"{PACKAGE}.{name}")


class Watch:
    """Raises `Hang` once an input has taken too long, without what it has waited for a processor.

    Parameters
    ----------
    limit : float
        Seconds.
    """

    def __init__(self, limit: float) -> None:
        self.limit = limit

    def start(self) -> None:
        """Count from now on."""
        self._began, self._waited = time.monotonic(), _waited()
        signal.signal(signal.SIGALRM, self._look)
        signal.setitimer(signal.ITIMER_REAL, self.limit)

    def _look(self, number: int, frame: object) -> None:
        took = time.monotonic() - self._began - (_waited() - self._waited)
        if took > 0.99 * self.limit:
            raise Hang
        signal.setitimer(signal.ITIMER_REAL, self.limit - took)


def _waited(process: int | str = "self") -> float:
    """Seconds that a process was ready, and others had the processor."""
    try:
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, IndexError):  # it has ended
        return 0.0


def tried(module: ModuleType, data: bytes, told: Any, limit: float = LIMIT) -> str:
    """Give one input to a target; what is wrong with what it did, or nothing.

    `told` is the file that takes what is printed meanwhile, on both streams. What takes too long
    is tried a second time.
    """
    watch, words = Watch(limit), ""
    for again in (True, False):
        watch.start()
        try:
            module.attempt(data)
        except (Hang, TimeoutError):
            words = f"takes longer than {limit:g} s\n{traceback.format_exc()}"
            if again:
                continue  # a machine that has halted is no hang
        except (Exception, SystemExit, KeyboardInterrupt):
            words = traceback.format_exc()
        else:
            words = ""
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        break
    if told is not None:
        for stream in (sys.stdout, sys.stderr):  # what it has printed is this input's
            with contextlib.suppress(Exception):
                stream.flush()
        size = os.lseek(told, 0, os.SEEK_CUR)
        if size:
            if not words:
                text = os.pread(told, 1 << 20, 0).decode(errors="replace")
                words = text if "Traceback" in text else ""
            os.ftruncate(told, 0)
            os.lseek(told, 0, os.SEEK_SET)
    return words


def work(name: str, seed: int, first: int, count: int, limit: float, now: Path) -> None:
    """Be a worker: say on stdout how many inputs are done, and the words of each fault.

    The input under way is in the file `now`, for who finds this process dead.
    """
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    report = os.fdopen(os.dup(1), "wb", buffering=0)
    with tempfile.TemporaryDirectory() as there, tempfile.TemporaryFile() as told:
        os.chdir(there)
        errors = os.fdopen(os.dup(2), "w")
        for descriptor in (1, 2):
            os.dup2(told.fileno(), descriptor)
        sys.stderr = errors  # for who starts it: what cannot begin
        module = target(name)
        inputs = itertools.islice(module.fuzz(seed, count), first, None)
        ahead = [*itertools.islice(inputs, 1)]
        sys.stderr = sys.__stderr__
        with open(now, "wb", buffering=0) as under_way:
            for data in itertools.chain(ahead, inputs):
                under_way.seek(0)
                under_way.truncate()
                under_way.write(data)
                words = tried(module, data, told.fileno(), limit)
                body = words.encode(errors="backslashreplace")
                kept = data if words else b""
                report.write(_DONE.pack(len(body), len(kept)) + body + kept)
        os.chdir("/")


class Worker:
    """A process that takes a batch of one target's inputs."""

    def __init__(self, name: str, seed: int, count: int, limit: float, first: int = 0) -> None:
        self.name, self.seed, self.count, self.limit, self.done = name, seed, count, limit, first
        handle, path = tempfile.mkstemp(prefix="pea-fuzz-")
        os.close(handle)
        self.now = Path(path)
        told = [name, str(seed), str(first), str(count), repr(limit), path]
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--work", *told],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        assert self.process.stdout is not None
        os.set_blocking(self.process.stdout.fileno(), False)
        self.buffer = b""
        self.begun = first > 0
        self.moved = time.monotonic() + 60.0  # to import what it needs
        self.waited = 0.0

    def look(self) -> tuple[int, list[Fault], bool]:
        """Inputs done since the last look, faults among them, whether the worker has ended."""
        assert self.process.stdout is not None
        ended = self.process.poll() is not None
        done, faults = 0, []
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self.process.stdout.fileno(), 1 << 16):
                self.buffer += data
        while len(self.buffer) >= _DONE.size:
            words, kept = _DONE.unpack_from(self.buffer)
            end = _DONE.size + words + kept
            if len(self.buffer) < end:
                break
            body = self.buffer[_DONE.size : end]
            self.buffer = self.buffer[end:]
            done += 1
            if words:
                told = body[:words].decode(errors="replace")
                faults.append(Fault(self.name, body[words:], told))
        if done:
            self.begun, self.moved = True, time.monotonic()
            self.waited = _waited(self.process.pid)
        self.done += done
        stuck = time.monotonic() - self.moved
        if not ended and stuck > GRACE * self.limit:  # less what it waited for a processor
            stuck -= _waited(self.process.pid) - self.waited
        if not ended and stuck > GRACE * self.limit:
            self.process.kill()
            self.process.wait()
            faults.append(Fault(self.name, self.now.read_bytes(), "hangs, and no signal ends it"))
            self.done += 1
            return done + 1, faults, True
        if ended and self.done < self.count:
            assert self.process.stderr is not None
            words = self.process.stderr.read().decode(errors="replace")
            if not self.begun:
                raise SystemExit(f"{self.name} does not start:\n{words}")
            told = f"the process has ended with {self.process.returncode}\n{words}"
            faults.append(Fault(self.name, self.now.read_bytes(), told))
            self.done += 1
            return done + 1, faults, True
        return done, faults, ended

    def close(self) -> None:
        """End it."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()
        self.now.unlink(missing_ok=True)


def plan(chosen: list[str], inputs: int, seed: int) -> Iterator[tuple[str, int, int]]:
    """Target, seed and number of inputs of each batch, the targets in turn."""
    shares = {name: float(getattr(target(name), "SHARE", 1.0)) for name in chosen}
    whole = sum(shares.values())
    left = {name: max(1, round(inputs * share / whole)) for name, share in shares.items()}
    for turn in itertools.count():
        if not any(left.values()):
            return
        for name, count in left.items():
            batch = min(count, BATCH)
            if batch:
                left[name] -= batch
                yield name, seed * 1_000_003 + turn, batch


class Told(NamedTuple):
    """What has come of a run so far."""

    faults: list[Fault]
    done: dict[str, int]


def run(chosen: list[str], inputs: int, seed: int, jobs: int, limit: float, told: Told) -> None:
    """Run them all and show how far it is."""
    from pea_core.console import bar, err

    batches = list(plan(chosen, inputs, seed))
    total = {name: sum(n for t, _, n in batches if t == name) for name in chosen}
    working: list[Worker] = []
    todo = iter(batches)
    with bar(err) as progress:
        tasks = {name: progress.add_task(name, total=count) for name, count in total.items()}
        try:
            while True:
                while len(working) < jobs and (batch := next(todo, None)) is not None:
                    working.append(Worker(*batch, limit))
                if not working:
                    return
                for worker in list(working):
                    done, found, ended = worker.look()
                    progress.advance(tasks[worker.name], done)
                    told.done[worker.name] = told.done.get(worker.name, 0) + done
                    told.faults.extend(found)
                    if ended:
                        worker.close()
                        working.remove(worker)
                        if worker.done < worker.count:  # the rest, without the one at fault
                            rest = (worker.name, worker.seed, worker.count, limit, worker.done)
                            working.append(Worker(*rest))
                time.sleep(0.02)
        finally:
            for worker in working:
                worker.close()


def keep(faults: list[Fault], there: Path) -> None:
    """Keep the inputs at fault, each with what it did."""
    there.mkdir(parents=True)
    counts: dict[str, int] = {}
    for fault in faults:
        number = counts[fault.target] = counts.get(fault.target, 0) + 1
        if number <= KEPT_MAX:
            path = there / f"{fault.target}-{number}"
            path.write_bytes(fault.data)
            path.with_suffix(".txt").write_text(fault.words, encoding="utf-8")


def again(path: Path, limit: float) -> int:
    """Try a kept input once more, with everything shown."""
    data = path.read_bytes()
    module = target(path.name.rpartition("-")[0])
    with tempfile.TemporaryDirectory() as there:
        os.chdir(there)
        words = tried(module, data, None, limit)
        os.chdir("/")
    print(words or "no fault")
    return 1 if words else 0


def main() -> int:
    """Run the command."""
    if sys.argv[1:2] == ["--work"]:
        name, seed, first, count, limit, now = sys.argv[2:]
        work(name, int(seed), int(first), int(count), float(limit), Path(now))
        return 0
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=", ".join(names()))
    parser.add_argument("--inputs", type=int, default=INPUTS, help=f"of all (default: {INPUTS})")
    parser.add_argument("--seed", type=int, help="default: another one each time")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds of an input")
    parser.add_argument("--again", type=Path, metavar="FILE", help="try a kept input once more")
    arguments = parser.parse_args()
    if arguments.again:
        return again(arguments.again.resolve(), arguments.limit)
    chosen = arguments.targets or names()
    if unknown := set(chosen) - set(names()):
        parser.error(f"unknown target {sorted(unknown)[0]!r}: known are {', '.join(names())}")
    seed = random.SystemRandom().randrange(2**32) if arguments.seed is None else arguments.seed
    print(f"seed {seed}: {arguments.inputs} inputs to {', '.join(chosen)}", flush=True)
    began = time.monotonic()
    faults, status = [], 0
    told = Told(faults, {})
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        run(chosen, arguments.inputs, seed, max(arguments.jobs, 1), arguments.limit, told)
    except KeyboardInterrupt:
        status = 130
        print("interrupted: " + ", ".join(f"{n} {name}" for name, n in sorted(told.done.items())))
    took, done = time.monotonic() - began, sum(told.done.values())
    print(f"{done} inputs in {took:.0f} s, {len(faults)} at fault (seed {seed})")
    if not faults:
        return status
    there = Path("runs") / time.strftime("fuzz-%Y%m%d-%H%M%S")
    keep(faults, there)
    for name in chosen:
        if count := sum(fault.target == name for fault in faults):
            words = next(f.words for f in faults if f.target == name).strip().split("\n")
            print(f"{name}: {count}, the first: {words[0]} ... {words[-1][:200]}")
    print(f"inputs at fault are in {there}; try one again with --again FILE")
    return 1


if __name__ == "__main__":
    sys.exit(main())
