"""A few inputs that nobody meant, the same each time; ``make fuzz`` gives very many others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

FUZZ = Path(__file__).parent / "fuzz" / "run.py"


def test_no_input_is_at_fault(tmp_path):
    command = [sys.executable, str(FUZZ), "--inputs", "90", "--seed", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=115)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "90 inputs" in done.stdout


def test_an_input_at_fault_is_kept_and_can_be_tried_again(tmp_path):
    """Of a target that is broken: it raises, hangs, ends its process, prints a traceback."""
    there = tmp_path / "fuzz"
    there.mkdir()
    for name in ("__init__.py", "run.py"):
        (there / name).write_text((FUZZ.parent / name).read_text())
    (there / "broken.py").write_text(
        "import os, time\n"
        "def fuzz(seed, n):\n    yield from (b'%d' % (i % 6) for i in range(n))\n"
        "def attempt(data):\n"
        "    if data == b'1': raise ValueError('wrong')\n"
        "    if data == b'2': time.sleep(60)\n"
        "    if data == b'3': os._exit(7)\n"
        "    if data == b'4': print('Traceback of somebody')\n"
    )
    command = [sys.executable, str(there / "run.py")]
    more = ["--inputs", "6", "--seed", "5", "--jobs", "1", "--limit", "0.2"]
    done = subprocess.run([*command, *more], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert "6 inputs in" in done.stdout
    assert "4 at fault (seed 5)" in done.stdout
    kept = {path.read_bytes(): path for path in tmp_path.glob("runs/fuzz-*/broken-?")}
    assert set(kept) == {b"1", b"2", b"3", b"4"}
    assert "takes longer than 0.2 s" in kept[b"2"].with_suffix(".txt").read_text()
    assert "ended with 7" in kept[b"3"].with_suffix(".txt").read_text()
    words = [*command, "--again", str(kept[b"1"])]
    again = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert (again.returncode, "ValueError: wrong" in again.stdout) == (1, True)
