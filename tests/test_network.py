"""Nobody outside this machine finds a node, and no socket of a node answers from there."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NAMESPACE, HERE, THERE = "pea_outside", "198.51.100.1", "198.51.100.2"

OUTSIDE = """
import socket, sys, time
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

here, ports = sys.argv[1], [int(port) for port in sys.argv[2:]]
for port in ports:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((here, port))
        probe.settimeout(1.0)
        try:
            probe.send(b"RTPS" + bytes(60))
            probe.recv(1)
            print("answered", port)
        except ConnectionRefusedError:
            print("refused", port)
        except TimeoutError:
            print("taken", port)
rclpy.init()
node = Node("outsider")
node.create_publisher(String, "/pea/_outside", 1)
end = time.monotonic() + 5.0
while time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print("nodes", sorted(name for name in node.get_node_names() if name != "outsider"))
"""


def sockets(pid: int) -> list[tuple[str, int]]:
    """Local addresses of the UDP sockets that a process holds."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            inodes.add(os.readlink(entry).removeprefix("socket:[").removesuffix("]"))
    found = []
    for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]:
        words = line.split()
        if words[9] in inodes:
            address, port = words[1].split(":")
            found.append((socket.inet_ntoa(bytes.fromhex(address)[::-1]), int(port, 16)))
    return found


def test_a_node_listens_on_this_machine_alone(ros):
    ros.start("plant")
    ros.says("plant", "waiting for")
    domain = int(ros.env["ROS_DOMAIN_ID"])
    listens = {
        port: address
        for address, port in sockets(ros.processes["plant"].pid)
        if 7400 + 250 * domain <= port < 7650 + 250 * domain
    }
    assert len(listens) == 2  # discovery and data; what else there is only sends
    assert set(listens.values()) == {"127.0.0.1"}


@pytest.fixture
def outside() -> Iterator[list[str]]:
    """A network namespace with a cable to this one: the command that runs something there."""
    if os.geteuid() or not shutil.which("ip"):
        pytest.skip("network namespaces need root and iproute2")

    def ip(*words: str) -> Any:
        return subprocess.run(["ip", *words], capture_output=True, text=True, check=False)

    made = ip("netns", "add", NAMESPACE)
    if made.returncode:
        pytest.skip(f"no network namespace: {made.stderr.strip()}")
    try:
        for words in (
            ("link", "add", "pea_here", "type", "veth", "peer", "name", "pea_there"),
            ("link", "set", "pea_there", "netns", NAMESPACE),
            ("addr", "add", f"{HERE}/30", "dev", "pea_here"),
            ("link", "set", "pea_here", "up"),
            ("-n", NAMESPACE, "addr", "add", f"{THERE}/30", "dev", "pea_there"),
            ("-n", NAMESPACE, "link", "set", "pea_there", "up"),
            ("-n", NAMESPACE, "link", "set", "lo", "up"),
            ("-n", NAMESPACE, "route", "add", "default", "dev", "pea_there"),
        ):
            done = ip(*words)
            if done.returncode:
                pytest.skip(f"ip {' '.join(words)}: {done.stderr.strip()}")
        yield ["ip", "netns", "exec", NAMESPACE]
    finally:
        ip("netns", "del", NAMESPACE)
        ip("link", "del", "pea_here")


def test_from_another_network_nothing_answers_and_nobody_is_found(ros, outside):
    ros.start("plant")
    ros.says("plant", "waiting for")
    ports = sorted({port for _, port in sockets(ros.processes["plant"].pid)})
    env = {**ros.env, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_STATIC_PEERS": HERE}
    del env["FASTRTPS_DEFAULT_PROFILES_FILE"]
    command = [*outside, sys.executable, "-c", OUTSIDE, HERE, *map(str, ports)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0, done.stderr
    assert "nodes []" in done.stdout, done.stdout
    assert "answered" not in done.stdout
    domain = int(ros.env["ROS_DOMAIN_ID"])
    rtps = [port for port in ports if 7400 + 250 * domain <= port < 7650 + 250 * domain]
    assert all(f"refused {port}" in done.stdout for port in rtps), done.stdout
    assert ros.processes["plant"].poll() is None
