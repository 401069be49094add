"""Where nothing is set, a process stays on this machine and finds others at once."""

import os
from pathlib import Path

import pytest
from domain_coordinator import domain_id

from pea_ros.context import context
from pea_ros.discovery import stay

RANGE, PROFILE = "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"


@pytest.mark.parametrize("before", [{}, {RANGE: "", PROFILE: ""}])
def test_what_is_not_set_is_set(before):
    env = dict(before)
    stay(env)
    assert env.keys() == {RANGE, PROFILE}
    assert env[RANGE] == "LOCALHOST"
    assert "<leaseAnnouncement>" in Path(env[PROFILE]).read_text()


def test_what_the_user_asks_for_is_kept():
    asked = {RANGE: "SUBNET", PROFILE: "/mine.xml"}
    env = dict(asked)
    stay(env)
    assert env == asked


def test_the_middleware_starts_with_it(monkeypatch):
    for name in (RANGE, PROFILE):
        monkeypatch.setenv(name, "")
    with domain_id() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with context():
            pass
    assert os.environ[RANGE] == "LOCALHOST"
    assert Path(os.environ[PROFILE]).exists()


@pytest.mark.parametrize("asked", [{RANGE: "SUBNET"}, {"ROS_STATIC_PEERS": "192.0.2.9"}])
def test_over_a_network_the_profile_keeps_no_socket_from_it(asked):
    env = dict(asked)
    stay(env)
    assert "127.0.0.1" not in Path(env[PROFILE]).read_text()
