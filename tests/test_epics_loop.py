"""The EPICS bridge on a loop that runs: a client reads, changes, is refused, and stops it."""

from __future__ import annotations

import signal
import socket
import time

import pytest
from caproto import ErrorResponseReceived
from caproto.sync import client

from pea_record.read import load_axes

MODES = {"composed": ("--clock", "wall"), "distributed": ()}
COMPILED = {"composed": "1", "distributed": "0"}
"""A loop in Python would leave the parameters in its process no time to answer."""

INVALID = 3
PATIENCE = 60.0


@pytest.fixture
def channel_access(monkeypatch):
    """Environment of a client and a server that meet on this machine alone."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = str(found.getsockname()[1])
    names = {
        "EPICS_CA_ADDR_LIST": "127.0.0.1",
        "EPICS_CA_AUTO_ADDR_LIST": "NO",
        "EPICS_CA_SERVER_PORT": port,
        "EPICS_CAS_SERVER_PORT": port,
    }
    for name, value in names.items():
        monkeypatch.setenv(name, value)
    return names


def until(true):
    end = time.monotonic() + PATIENCE
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.05)
    return found


def ask(name, **options):
    return client.read(f"LAB:{name}", timeout=20, repeater=False, **options)


def read(name):
    return ask(name).data[0]


def write(name, value):
    client.write(f"LAB:{name}", value, notify=True, timeout=20, repeater=False)


def answer(name, value):
    """Write, again where a busy machine is late; "accepted", or why not."""

    def told():
        try:
            write(name, value)
        except ErrorResponseReceived as error:
            text = bytes(error.args[0].error_message).decode()
            return None if "does not answer" in text else text
        return "accepted"

    return until(told)


@pytest.mark.alone
@pytest.mark.timeout(900)
@pytest.mark.parametrize("mode", MODES)
def test_a_client_reads_changes_and_stops_a_loop(
    mode, start_pea, user_environment, free_domain, channel_access
):
    env = user_environment(
        ROS_DOMAIN_ID=str(free_domain),
        PYTHONUNBUFFERED="1",
        PEA_COMPILE=COMPILED[mode],
        **channel_access,
    )
    command = ("run", "fig9_hysteresis_10hz", "--mode", mode, *MODES[mode], "--duration", "900")
    loop = start_pea(*command, "--out", "run", env=env)
    assert until(lambda: loop.bag_size() > 64 * 1024 or loop.process.poll() is not None)
    assert loop.process.poll() is None, loop.err.read_text()
    bridge = start_pea("bridge", "epics", "--prefix", "LAB:", env=env)
    until(
        lambda: "process variables" in bridge.out.read_text() or bridge.process.poll() is not None
    )
    assert bridge.process.poll() is None, bridge.err.read_text()

    assert until(lambda: -1.0 < read("Y") < 11.0)  # um
    before = read("Y"), read("U"), read("W")
    assert until(lambda: all(a != read(n) for a, n in zip(before, ("Y", "U", "W"))))
    assert read("GAIN:P") == 0.0004
    assert answer("GAIN:P", 0.0003) == "accepted"
    assert until(lambda: read("GAIN:P") == 0.0003)
    assert "P out of range" in answer("GAIN:P", -1.0)
    assert read("GAIN:P") == 0.0003
    assert b"P out of range" in read("MESSAGE")
    assert answer("SETPOINT", 5.5) == "accepted"
    assert until(lambda: read("SETPOINT") == 5.5)

    write("STOP", 1)
    assert read("MESSAGE") != b""
    loop.finish(PATIENCE)
    assert until(lambda: ask("Y", data_type="status").metadata.severity == INVALID)
    bridge.process.send_signal(signal.SIGINT)
    done = bridge.finish()
    assert done.status == 130
    assert "Traceback" not in done.err
    changes = [c for event in load_axes(loop.there / "run").events for c in event.changed.items()]
    assert ("P", 0.0003) in changes
    assert ("offset_um", 5.5) in changes
    assert ("P", -1.0) not in changes
