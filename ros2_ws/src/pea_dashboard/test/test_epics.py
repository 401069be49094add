"""The soft IOC, asked by a real client over Channel Access on this machine."""

import asyncio
import contextlib
import socket
import threading
import time

import pytest
from caproto import AlarmSeverity, ErrorResponseReceived
from caproto.sync import client

from pea_core.params import ParameterError
from pea_dashboard.epics import READINGS, Ioc

PREFIX = "TEST:"


class Desk:
    """A loop that somebody has written down."""

    def __init__(self):
        self.values = {"P": 0.0012, "I": 6.0}
        self.offset, self.stopped, self.late = 5.0, False, 0.0

    def readings(self):
        return {name: float(i) for i, name in enumerate(READINGS)}

    def age(self):
        return self.late

    def gains(self):
        return dict(self.values)

    def setpoint(self):
        return self.offset

    def set(self, role, values):
        if role == "reference":
            self.offset = values["offset_um"]
        elif values.get("P", 0.0) > 0.01:
            raise ParameterError("P = 1: gain margin 0.1 < 1.3")
        else:
            self.values |= values

    def stop(self):
        self.stopped = True
        return "the stage has its safe voltage"


@pytest.fixture
def desk(monkeypatch):
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = str(found.getsockname()[1])
    for name, value in {
        "EPICS_CA_ADDR_LIST": "127.0.0.1",
        "EPICS_CA_AUTO_ADDR_LIST": "NO",
        "EPICS_CA_SERVER_PORT": port,
        "EPICS_CAS_SERVER_PORT": port,
        "EPICS_CAS_AUTO_BEACON_ADDR_LIST": "NO",
        "EPICS_CAS_BEACON_ADDR_LIST": "127.0.0.1",
    }.items():
        monkeypatch.setenv(name, value)
    there, loop = Desk(), asyncio.new_event_loop()
    task = loop.create_task(Ioc(there, PREFIX).serve())

    def serve():
        with contextlib.suppress(asyncio.CancelledError):  # the server takes it for its end
            loop.run_until_complete(task)
        loop.run_until_complete(loop.shutdown_default_executor())

    thread = threading.Thread(target=serve)
    thread.start()
    yield there
    loop.call_soon_threadsafe(task.cancel)
    thread.join(20)
    loop.close()


def read(name):
    return client.read(PREFIX + name, timeout=10, repeater=False).data[0]


def write(name, value):
    client.write(PREFIX + name, value, notify=True, timeout=10, repeater=False)


def test_readings_gains_setpoint_and_stop(desk):
    assert read("GAIN:P") == 0.0012
    assert read("SETPOINT") == 5.0
    write("GAIN:P", 0.001)
    assert desk.values["P"] == 0.001
    write("SETPOINT", 7.5)
    assert desk.offset == 7.5
    write("STOP", 1)
    assert desk.stopped
    assert b"safe voltage" in read("MESSAGE")
    assert read("Y") == 0.0
    assert read("W") == 5.0


def test_a_refused_gain_leaves_the_old_one_and_says_why(desk):
    with pytest.raises(ErrorResponseReceived):
        write("GAIN:P", 1.0)
    assert desk.values["P"] == 0.0012
    assert read("GAIN:P") == 0.0012
    assert b"gain margin" in read("MESSAGE")
    with pytest.raises(ErrorResponseReceived):
        write("Y", 1.0)


def until(true):
    end = time.monotonic() + 20.0
    while not (found := true()) and time.monotonic() < end:
        time.sleep(0.05)
    return found


def severity(name):
    answer = client.read(PREFIX + name, data_type="status", timeout=10, repeater=False)
    return answer.metadata.severity


def test_what_somebody_else_sets_is_followed(desk):
    desk.offset = 6.5
    desk.values["I"] = 3.0
    assert until(lambda: read("SETPOINT") == 6.5 and read("GAIN:I") == 3.0)


def test_readings_without_a_new_sample_are_invalid_until_one_comes(desk):
    assert until(lambda: read("U") == 3.0)
    assert severity("Y") == AlarmSeverity.NO_ALARM
    desk.late = 60.0
    assert until(lambda: severity("Y") == AlarmSeverity.INVALID_ALARM)
    assert b"no new sample" in read("MESSAGE")
    desk.late = 0.0
    assert until(lambda: severity("Y") == AlarmSeverity.NO_ALARM)
