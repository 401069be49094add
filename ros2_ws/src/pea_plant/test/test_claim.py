"""One process drives a device."""

import subprocess
import sys

import pytest

from pea_core.params import ParameterError
from pea_plant.drivers.claim import claim

ADDRESS, DEVICE = "serial:/dev/ttyUSB0", __file__

HOLD = """
import sys
from pea_plant.drivers.claim import claim
held = claim("here", "serial", sys.argv[1])
print("held", flush=True)
sys.stdin.read()
"""


def test_a_device_is_another_process_s_until_that_has_died():
    words = [sys.executable, "-c", HOLD, DEVICE]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(ParameterError, match="'serial:/dev/ttyUSB0': another process"):
            claim(ADDRESS, "serial", DEVICE)
        other.kill()
    assert claim(ADDRESS, "serial", DEVICE)


def test_a_process_may_hold_it_twice_and_leaves_it_with_the_last():
    first = claim(ADDRESS, "serial", DEVICE)
    second = claim(ADDRESS, "serial", DEVICE)
    del first
    words = [sys.executable, "-c", HOLD, DEVICE]
    done = subprocess.run(words, input=b"", capture_output=True)
    assert b"another process of this machine drives it" in done.stderr
    del second
    assert subprocess.run(words, input=b"", capture_output=True).stdout == b"held\n"
