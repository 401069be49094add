"""Ctrl-C in the moment in which LLVM hands over what it has compiled."""

import subprocess
import sys

import pytest

pytest.importorskip("numba")

SCRIPT = """
import signal
from numba.core import codegen

hook = codegen.CPUCodeLibrary._object_compiled_hook.__func__

@classmethod
def interrupted(cls, module, buffer):
    signal.raise_signal(signal.SIGINT)
    return hook(cls, module, buffer)

codegen.CPUCodeLibrary._object_compiled_hook = interrupted

from pea_core.interrupt import INTERRUPT
from pea_engine.kernel import compile_kernel

signal.signal(signal.SIGINT, INTERRUPT)
kernel = compile_kernel(lambda x: 2.0 * x)
try:
    print(kernel(3.0))
except KeyboardInterrupt:
    print("interrupted", bool(kernel.compiled.signatures))
"""


def test_it_is_no_lost_kernel_and_no_traceback(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "interrupted True\n"
