"""Bad luck: nodes and runs that are killed, interrupted, or run side by side."""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import pytest
from rosbags.highlevel import AnyReader

from pea_core.loop import LoopFault
from pea_experiment import experiments
from pea_record.read import load
from pea_ros import shared_memory
from pea_run import run
from pea_run.modes import MODES, distributed

FIG9 = "fig9_hysteresis_10hz"
LONG = ("run", FIG9, "--mode", "distributed", "--duration", "20", "--out", "run")
SHORT = ("run", FIG9, "--mode", "distributed", "--duration", "0.0157", "--out", "run", "--json")
NODES = ("plant", "observer", "controller", "reference")
RECORDER = "recorder"


@pytest.fixture
def left(open_files: Callable[[int], set[Path]]) -> Callable[[set[Path]], set[Path]]:
    """Which of the files in shared memory are still there, though nobody uses them."""

    before = set(Path("/dev/shm").iterdir())

    def still_there(files: set[Path]) -> set[Path]:
        there = {path for path in files - before if path.exists()}
        for process in Path("/proc").glob("[0-9]*") if there else ():
            with contextlib.suppress(OSError):
                there -= open_files(int(process.name))
        return there

    return still_there


@pytest.mark.parametrize(
    ("after", "words"),
    [("sleep 60", "has not closed the bag"), ("exit 3", "recorder ended with status 3: disk full")],
)
def test_recorder_that_has_all_and_cannot_close_the_bag_fails_the_run(
    tmp_path, monkeypatch, after, words
):
    monkeypatch.setattr(distributed, "STALLED", 1.0)
    crew = distributed.Crew(tmp_path / "log", os.environ)
    (crew.log / "recorder.log").write_text("recorder: disk full\n")
    recorder = subprocess.Popen(["sh", "-c", f"echo 3; {after}"], stdout=subprocess.PIPE)
    crew.processes[RECORDER] = recorder
    try:
        with pytest.raises(LoopFault, match=words):
            distributed.watch(crew, recorder, 3, lambda done: None)
    finally:
        crew.end()
        recorder.stdout.close()


def samples_in(directory: Path) -> int:
    """Samples of a bag that other people's libraries can read."""
    with AnyReader([directory]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    recording = load(directory)
    assert recording.damage == ""
    assert min(counts[t] for t in ("/pea/displacement", "/pea/state", "/pea/voltage")) > 0
    return len(recording.samples)


def environment_of(pid: int) -> dict[str, str]:
    words = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
    return dict(word.split("=", 1) for word in words if "=" in word)


@pytest.mark.parametrize("node", ["observer", RECORDER])
def test_killed_node_is_named_and_the_others_end(start_pea, ended, left, node):
    running = start_pea(*LONG)
    crew = running.crew()
    running.midway()
    files = running.shared_memory()
    assert files
    os.kill(crew[node], signal.SIGKILL)
    done = running.finish()
    assert done.status == 3
    assert f"pea: {node} was killed by SIGKILL" in done.err
    assert [n for n in (*NODES, RECORDER) if f"pea: {n}" in done.err] == [node]
    assert "Traceback" not in done.err
    assert ended(crew, 0.0)
    assert left(files) == set()
    if node != RECORDER:
        assert samples_in(running.there / "run") > 0
    else:
        assert len(load(running.there / "run").samples) > 0


def test_terminated_run_blames_nobody(start_pea, ended, left):
    running = start_pea(*LONG)
    crew = running.crew()
    running.midway()
    files = running.shared_memory()
    running.process.send_signal(signal.SIGTERM)
    done = running.finish()
    assert done.status == 130
    assert "pea:" not in done.err
    assert "Traceback" not in done.err
    assert "interrupted" in done.err
    assert ended(crew, 0.0)
    assert left(files) == set()
    assert samples_in(running.there / "run") > 0


def test_second_interrupt_leaves_nothing_behind(start_pea, ended):
    running = start_pea(*LONG)
    crew = running.crew()
    running.midway()
    running.process.send_signal(signal.SIGINT)
    time.sleep(0.05)  # the second comes while the first is handled, at whatever point
    running.process.send_signal(signal.SIGINT)
    done = running.finish()
    assert done.status == 130
    assert "Traceback" not in done.err
    assert ended(crew, 0.0)


def test_interrupt_while_nodes_start_leaves_nothing_behind(start_pea, ended):
    running = start_pea(*LONG)
    crew = running.crew()
    running.process.send_signal(signal.SIGINT)
    done = running.finish()
    assert done.status == 130
    assert "Traceback" not in done.err
    assert ended(crew, 0.0)


def test_killed_run_leaves_no_nodes(start_pea, ended):
    running = start_pea(*LONG)
    crew = running.crew()
    running.midway()
    running.process.kill()
    running.process.wait()
    assert ended(crew, 20.0)
    assert samples_in(running.there / "run") > 0


def test_runs_side_by_side_do_not_hear_each_other(start_pea, recorded):
    alone = recorded("batch", FIG9, "--duration", "0.0157").metrics["trace_sha256"]
    runs = [start_pea(*SHORT) for _ in range(2)]
    domains = {environment_of(run.crew()["plant"])["ROS_DOMAIN_ID"] for run in runs}
    assert len(domains) == 2
    assert [run.finish().metrics["trace_sha256"] for run in runs] == [alone] * 2


@pytest.mark.parametrize("discovery", ["", "SYSTEM_DEFAULT"])
def test_users_own_environment_is_kept(start_pea, user_environment, free_domain, discovery):
    """Where the user says nothing of discovery, the nodes stay on this machine."""
    env = user_environment(ROS_DOMAIN_ID=str(free_domain), ROS_AUTOMATIC_DISCOVERY_RANGE=discovery)
    running = start_pea(*LONG, env=env)
    for pid in running.crew().values():
        found = environment_of(pid)
        assert found["ROS_DOMAIN_ID"] == str(free_domain)
        assert found["ROS_AUTOMATIC_DISCOVERY_RANGE"] == (discovery or "LOCALHOST")


def test_existing_directory_is_refused_and_nothing_started(start_pea):
    running = start_pea("list")
    running.finish()
    kept = running.there / "run"
    kept.mkdir()
    (kept / "metadata.yaml").write_text("mine")
    again = type(running)(LONG, running.there, dict(os.environ))
    done = again.finish()
    assert done.status == 2
    assert done.out == ""
    assert done.err.count("\n") == 1
    assert "run: exists" in done.err
    assert [p.name for p in kept.iterdir()] == ["metadata.yaml"]
    assert (kept / "metadata.yaml").read_text() == "mine"


@pytest.mark.parametrize("mode", ["batch", "distributed"])
def test_full_disk_ends_the_run_in_one_line(start_pea, mode):
    running = start_pea("run", FIG9, "--mode", mode, "--out", "run", "--json", file_size=100 * 1024)
    done = running.finish()
    assert done.status == 3
    assert "Traceback" not in done.err
    assert sum(line.startswith("pea: ") for line in done.err.splitlines()) == 1
    assert "File too large" in done.err
    assert done.out == ""
    assert not (running.there / "run" / "metrics.json").exists()


@pytest.fixture
def segment(tmp_path, monkeypatch) -> list[Path]:
    """The three files of a Fast DDS port that nobody uses."""
    monkeypatch.setattr(shared_memory, "FOLDER", tmp_path)
    files = [
        tmp_path / name
        for name in ("fastrtps_port1", "fastrtps_port1_el", "sem.fastrtps_port1_mutex")
    ]
    for file in files:
        file.write_bytes(bytes(64))
    return files


def test_dead_segment_is_swept_whole(segment):
    shared_memory.sweep()
    assert not any(file.exists() for file in segment)


@pytest.mark.parametrize("part", [0, 2], ids=["memory", "mutex"])
def test_segment_in_use_is_kept_whole(segment, part):
    with open(segment[part], "r+b") as file, mmap.mmap(file.fileno(), 0):
        shared_memory.sweep()
        assert all(file.exists() for file in segment)


def test_locked_segment_is_kept_whole(segment):
    with open(segment[1], "rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        shared_memory.sweep()
        assert all(file.exists() for file in segment)


def test_port_without_its_lock_does_not_outlive_the_next_run(segment):
    segment[1].unlink()
    with shared_memory.swept():
        assert not any(file.exists() for file in segment)


@pytest.mark.parametrize("mode", MODES)
def test_a_run_in_any_mode_removes_what_a_killed_one_has_left(segment, tmp_path, monkeypatch, mode):
    seen = []
    monkeypatch.setitem(
        MODES, mode, lambda *_, **__: seen.extend(file for file in segment if file.exists())
    )
    experiment = experiments.load("fig4_pid_step", [], 0.001)
    measured = run.run(experiment, mode, tmp_path, lambda done: None, recorded=False)
    assert measured["mode"] == mode
    assert not seen
    assert not any(file.exists() for file in segment)


class Idle:
    """A crew whose processes live and say nothing more."""

    processes: ClassVar = {"plant": None}

    def check(self):
        pass

    def last_words(self, name):
        return ": waiting"


@pytest.mark.parametrize(
    ("looks", "fails"),
    [
        ([0.1] * 99, False),
        ([0.1] * 110, True),  # 11 s without a sample
        ([0.1, 12.0, 0.1], False),  # stopped meanwhile and continued, Ctrl-Z and fg
        ([3600.0] * 5, False),
        ([0.9] * 12, True),
    ],
)
def test_only_time_in_which_the_run_was_not_stopped_counts(looks, fails):
    now = [0.0]
    patience = distributed.Patience(Idle(), lambda: now[0])
    assert patience.move(5)
    assert not patience.move(5)

    def look():
        for pause in looks:
            now[0] += pause
            patience.look()

    if not fails:
        look()
        return
    with pytest.raises(LoopFault, match="stands still at sample 5: plant: waiting"):
        look()


def test_a_run_without_a_recorder_sees_that_the_loop_stands_still(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed, "STALLED", 0.3)
    crew = distributed.Crew(tmp_path / "log", os.environ)
    (crew.log / "plant.log").write_text("plant: no /pea/voltage\n")
    (crew.log / "samples").write_text("7")
    crew.processes["plant"] = subprocess.Popen(["sleep", "60"])
    done = []
    try:
        with pytest.raises(LoopFault, match="stands still at sample 7: plant: no /pea/voltage"):
            distributed.wait(crew, crew.log / "samples", done.append)
    finally:
        crew.end()
    assert done == [0, 7]
