"""Ctrl-C around compiled code."""

import os
import signal
import threading

import pytest

from pea_core.interrupt import Interrupt


@pytest.fixture
def interrupt():
    handler = Interrupt()
    before = signal.signal(signal.SIGINT, handler)
    yield handler
    signal.signal(signal.SIGINT, before)


def test_raises_at_once(interrupt):
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)


def test_raises_when_it_may(interrupt):
    steps = []

    def work():
        with interrupt.held():
            os.kill(os.getpid(), signal.SIGINT)
            steps.append("held")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert steps == ["held"]


def test_raises_once(interrupt):
    with pytest.raises(KeyboardInterrupt), interrupt.held():
        os.kill(os.getpid(), signal.SIGINT)
    with interrupt.held():
        pass


def test_an_error_inside_goes_first(interrupt):
    def work():
        with interrupt.held():
            os.kill(os.getpid(), signal.SIGINT)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()


def test_another_handler_is_put_aside_and_called_at_the_end():
    handler, seen = Interrupt(), []

    def other(number, frame):
        seen.append(number)

    before = signal.signal(signal.SIGINT, other)
    try:
        with handler.held():
            os.kill(os.getpid(), signal.SIGINT)
            assert not seen
        assert signal.getsignal(signal.SIGINT) is other
        assert seen == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)


def test_another_thread_holds_nothing_off(interrupt):
    inside, leave = threading.Event(), threading.Event()

    def work():
        with interrupt.held():
            inside.set()
            leave.wait(10.0)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        assert inside.wait(10.0)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        leave.set()
        thread.join()
