"""Whatever a device sends, and however slowly: each exchange ends at its one deadline."""

import socket
import threading
import time

import pytest

from pea_core.params import ParameterError
from pea_drivers import transport
from pea_drivers.transport import Deadline
from pea_plant.drivers.driver import DriverError

LATE = 20.0
"""Seconds that a busy machine may add; what had no deadline would take minutes, or for ever."""


@pytest.fixture(params=["tcp", "serial"])
def line(request, kind):
    """Port of an emulator: TCP, or a pty."""
    if (kind, request.param) == ("modbus_daq", "serial"):
        pytest.skip("Modbus TCP runs over TCP")
    return 0 if request.param == "tcp" else None


def ends(act, *arguments):
    """See that an exchange fails in one line, and in time."""
    began = time.monotonic()
    with pytest.raises((DriverError, ParameterError)) as failure:
        act(*arguments)
    assert time.monotonic() - began < LATE
    assert "\n" not in str(failure.value)
    return str(failure.value)


@pytest.mark.parametrize("fault", ["drip=0.15", "babble", "mute"])
@pytest.mark.parametrize("act", ["exchange", "check"])
def test_an_exchange_ends_at_its_deadline(bench, line, fault, act):
    with bench.emulated(port=line) as device:
        babbles = fault == "babble"
        driver = bench.driver(device, driver__timeout_s=LATE if babbles else 0.1)
        driver.connect()
        device.inject(fault)
        u = () if act != "exchange" else (60.0,)
        if babbles and driver.NUMBERED:  # old answers are left out, at the full rate
            driver.way.drop = pytest.fail  # nothing is thrown away to get into step again
            getattr(driver, act)(*u)
            for _ in range(20):
                assert driver.way.comes_within(LATE)
                getattr(driver, act)(*u)
        elif babbles:  # the first answer is whole: what comes after belongs to nothing
            ends(lambda: [getattr(driver, act)(*u) for _ in range(10**4)])
        else:
            assert "no answer within 0.1 s" in ends(getattr(driver, act), *u)
        driver.close()


@pytest.mark.parametrize("fault", ["drip=0.15", "mute"])
def test_connecting_ends_at_its_deadline(bench, line, fault):
    with bench.emulated(port=line) as device:
        device.inject(fault)
        driver = bench.driver(device, driver__connect_s=0.1)
        assert device.address in ends(driver.connect)
        assert bench.untouched(device)
        assert driver.fileno() == -1


def test_an_answer_that_comes_twice_is_not_the_next_displacement(bench, device):
    driver = bench.driver(device, driver__timeout_s=1.0)
    driver.connect()
    say = device.say
    device.say = lambda way, answer: say(way, answer + answer)
    taken = 0
    for jump in range(1, 10):
        device.inject(f"jump={jump}")
        try:
            y = driver.read().y
        except DriverError:
            continue
        taken += 1
        assert y * 1e6 == pytest.approx(jump, abs=1e-3)
    assert taken == (9 if bench.kind == "modbus_daq" else 0)  # its answers have numbers
    driver.close()


def test_what_comes_between_two_questions_is_refused_once(bench, device):
    driver = bench.driver(device)
    driver.connect()
    (way,) = device.ways
    device.inject("jump=3")
    way.send({"gcs": b"1=7.0\n", "nv200": b"\x13meas,7.0\r\n\x11"}.get(bench.kind, b"1=7.0\n"))
    assert driver.way.comes_within(LATE)
    numbered = bench.kind == "modbus_daq"
    says = "no header of Modbus TCP" if numbered else "answers nothing that was asked"
    assert says in ends(driver.read)
    assert driver.read().y * 1e6 == pytest.approx(3.0, abs=1e-3)
    driver.close()


class Deaf:
    """A peer that is there and reads nothing."""

    def __enter__(self):
        self.listener = socket.socket()
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.listener.bind(("127.0.0.1", 0))
        self.listener.listen()
        return self

    @property
    def address(self):
        return f"tcp://127.0.0.1:{self.listener.getsockname()[1]}"

    def __exit__(self, *error):
        self.listener.close()


def test_a_send_ends_though_the_device_does_not_read():
    with Deaf() as peer:
        way = transport.connect(peer.address, Deadline(5.0))
        way.deadline = Deadline(0.2)
        assert "takes no request within 0.2 s" in ends(way.send, bytes(10**8))
        way.deadline = Deadline(0.2)  # a part has gone: nothing may follow it
        assert "broke off halfway" in ends(way.send, b"SVA 1 0\n")
        way.close()


def test_dropping_what_has_come_ends_though_more_comes():
    with Deaf() as peer:
        way = transport.connect(peer.address, Deadline(5.0))
        far, _ = peer.listener.accept()
        gone = threading.Event()

        def babble():
            while not gone.is_set():
                try:
                    far.sendall(b"1=0.0\n" * 1000)
                except OSError:
                    return

        talker = threading.Thread(target=babble)
        talker.start()
        assert way.comes_within(LATE)
        way.deadline = Deadline(0.2)
        assert "no answer within 0.2 s" in ends(lambda: [way.drop() for _ in pauses(way)])
        gone.set()
        way.close()
        far.close()
        talker.join(LATE)
        assert not talker.is_alive()


def pauses(way):
    """Once more whenever something has come: a moment of silence ends a drop, too."""
    while way.comes_within(LATE):
        yield


def test_a_name_server_that_is_silent_is_not_waited_for(monkeypatch):
    asked = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *words, **more: asked.wait(2 * LATE))
    said = ends(transport.connect, "tcp://device.example:5", Deadline(0.2))
    asked.set()
    assert "nobody answers within 0.2 s" in said


def test_a_connection_that_does_not_come_about_is_not_waited_for():
    with Deaf() as peer:
        peer.listener.listen(0)
        others = []
        for _ in range(3):  # the queue is full: the system leaves the next ones without an answer
            other = socket.socket()
            other.setblocking(False)
            other.connect_ex(peer.listener.getsockname())
            others.append(other)
        said = ends(transport.connect, peer.address, Deadline(0.3))
        assert "nobody answers within 0.3 s" in said
        for other in others:
            other.close()


def test_an_answer_that_has_come_is_taken_though_this_process_is_late():
    with Deaf() as peer:
        way = transport.connect(peer.address, Deadline(5.0))
        far, _ = peer.listener.accept()
        far.sendall(b"whole\n")
        assert way.comes_within(LATE)
        way.deadline = Deadline(0.0)
        assert way.receive() == b"whole\n"
        ends(way.receive)
        far.close()
        way.close()


def test_closing_is_seen_and_may_be_done_twice():
    with Deaf() as peer:
        way = transport.connect(peer.address, Deadline(5.0))
        peer.listener.accept()[0].close()
        assert "closed the connection" in ends(way.receive)
        way.close()
        way.close()
        assert way.fileno() == -1
