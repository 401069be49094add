"""One process drives a device, and no other user can keep it from that."""

import os
import pwd
import socket
import subprocess
import sys
import tempfile

import pytest

from pea_core import claim as claims
from pea_core.claim import claim
from pea_core.params import ParameterError

ADDRESS, DEVICE = "serial:/dev/ttyUSB0", __file__
PLACE = ("127.0.0.1", 1)
AS_ROOT = pytest.mark.skipif(os.getuid() != 0, reason="becomes another user")

HOLD = """
import sys
from pea_core.claim import claim
kind, place = sys.argv[1:3]
held = claim("here", kind, ("127.0.0.1", int(place)) if kind == "tcp" else place)
print("held", flush=True)
sys.stdin.read()
"""


def holding(kind, place):
    """A process that holds a claim, or has been refused; ended by the end of its input."""
    words = [sys.executable, "-c", HOLD, kind, str(place)]
    pipe = subprocess.PIPE
    return subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe)


def refused(kind, place):
    """Words with which another process is refused; empty where it is not."""
    with holding(kind, place) as other:
        said, wrong = other.communicate(b"")
    assert (said == b"held\n") == (other.returncode == 0)
    return wrong.decode().strip().rpartition("\n")[2]


@pytest.mark.parametrize(("kind", "place"), [("serial", DEVICE), ("tcp", 1)])
def test_a_device_is_another_process_s_until_that_has_died(kind, place):
    mine = PLACE if kind == "tcp" else place
    with holding(kind, place) as other:
        assert other.stdout.readline() == b"held\n"
        named = rf"process {other.pid}, user {pwd.getpwuid(os.getuid()).pw_name}\); end that first"
        with pytest.raises(ParameterError, match=rf"another process .* drives it \({named}"):
            claim(ADDRESS, kind, mine)
        other.kill()
    assert claim(ADDRESS, kind, mine)


@pytest.mark.parametrize(("kind", "place"), [("serial", DEVICE), ("tcp", 1)])
def test_a_process_may_hold_it_twice_and_leaves_it_with_the_last(kind, place):
    mine = PLACE if kind == "tcp" else place
    first = claim(ADDRESS, kind, mine)
    second = claim(ADDRESS, kind, mine)
    assert claims.held() == [second]
    del first
    assert "another process of this machine drives it" in refused(kind, place)
    del second
    assert refused(kind, place) == ""


def test_who_inherits_it_keeps_it():
    mine = claim(ADDRESS, "tcp", PLACE)
    heir = subprocess.Popen(
        [sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=(mine.fileno(),)
    )
    del mine
    assert "another process of this machine drives it" in refused("tcp", 1)
    heir.communicate(b"\n")
    assert refused("tcp", 1) == ""


def test_a_device_that_is_left_leaves_no_file():
    del_me = claim(ADDRESS, "tcp", PLACE)
    (path,) = (one.path for one in claims.held())
    assert path.exists()
    del del_me
    assert not path.exists()


ANOTHER = """
import os, socket, sys
os.setgroups([]); os.setgid(65534); os.setuid(65534)
{}
print("there", flush=True)
sys.stdin.read()
"""


def as_nobody(what):
    """A process of the user nobody that does something and stays."""
    words = [sys.executable, "-S", "-c", ANOTHER.format(what)]
    other = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert other.stdout.readline() == b"there\n"
    return other


@AS_ROOT
def test_a_claim_that_lives_to_the_end_of_its_process_leaves_no_file_and_no_words():
    """A script of a lab's own that ends without closing its driver."""
    late = HOLD.replace("sys.stdin.read()", "sys.held = held; print(held.path); del held")
    words = [sys.executable, "-c", late, "tcp", "1"]
    done = subprocess.run(words, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    held, path = done.stdout.split()
    assert (held, done.stderr, os.path.exists(path)) == ("held", "", False)


def test_no_other_user_can_hold_a_name():
    names = "s = socket.socket(socket.AF_UNIX); s.bind(chr(0) + \"pea tcp ('127.0.0.1', 1)\")"
    with as_nobody(names) as other:
        assert claim(ADDRESS, "tcp", PLACE)
        other.communicate()


@AS_ROOT
def test_no_other_user_can_lock_the_file():
    mine = claim(ADDRESS, "tcp", PLACE)
    (path,) = (one.path for one in claims.held())
    tries = f"""
for flags in (os.O_RDONLY, os.O_RDWR | os.O_CREAT):
    for name in ({str(path)!r}, {str(path)!r} + "x"):
        try:
            os.open(name, flags)
        except PermissionError:
            continue
        sys.exit(1)
"""
    with as_nobody(tries) as other:
        other.communicate()
    del mine


@AS_ROOT
def test_another_user_that_is_connected_is_named():
    with socket.socket() as device:
        device.bind(("127.0.0.1", 0))
        device.listen()
        place = device.getsockname()
        with as_nobody(f"s = socket.socket(); s.connect({place!r})") as other:
            with pytest.raises(ParameterError, match="user nobody of this machine is connected"):
                claim(ADDRESS, "tcp", place)
            other.communicate()
        assert claim(ADDRESS, "tcp", place)


@AS_ROOT
def test_a_folder_that_another_user_has_made_is_named(monkeypatch):
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)
        taken = os.path.join(folder, f"pea-{os.getuid()}")
        with as_nobody(f"os.mkdir({taken!r})") as other:
            monkeypatch.setattr(claims, "TEMPORARY", folder)
            monkeypatch.setattr(claims, "RUNTIME", folder + "/none")
            with pytest.raises(ParameterError, match="user nobody has made it: remove it"):
                claim(ADDRESS, "tcp", PLACE)
            other.communicate()
