"""Layouts for viewers: every panel is placed, every path leads to a number of a recorded bag."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from pea_wire.topics import RECORDED_TOPICS

SHORT = ("fig9_hysteresis_10hz", "--duration", "0.0157")
TYPES = {topic.name: topic.type for topic in RECORDED_TOPICS}
LAYOUTS = Path(__file__).parent.parent / "config" / "layouts"


@pytest.fixture
def messages(recorded) -> dict[str, Any]:
    """A message of each topic of a bag of four nodes, as another library decodes it."""
    bag: Path = recorded("distributed", *SHORT).directory
    found = {}
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            found[connection.topic] = reader.deserialize(data, connection.msgtype)
    return found


def along(message: Any, path: str) -> Any:
    """What `path`, as in ``.points[0].positions[0]``, leads to."""
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        message = getattr(message, name) if name else message[int(index)]
    return message


def panels(tree: Any) -> Iterator[str]:
    """Names of the panels in a tree of splits."""
    if isinstance(tree, str):
        yield tree
    else:
        assert tree["direction"] in ("row", "column")
        assert 0 < tree["splitPercentage"] < 100
        yield from panels(tree["first"])
        yield from panels(tree["second"])


@pytest.fixture
def foxglove() -> Any:
    return json.loads((LAYOUTS / "foxglove.json").read_text())


def paths(layout: Any) -> set[str]:
    """Every message path that is plotted."""
    found = set()
    for panel in layout["configById"].values():
        drawn = [*panel.get("paths", []), *([panel["xAxisPath"]] if "xAxisPath" in panel else [])]
        assert all(path["enabled"] for path in drawn)
        assert all(path["timestampMethod"] == "receiveTime" for path in drawn)
        found |= {path["value"] for path in drawn}
    return found


def test_every_panel_of_foxglove_is_placed_once(foxglove):
    placed = list(panels(foxglove["layout"]))
    assert sorted(placed) == sorted(foxglove["configById"])
    assert {name.split("!")[0] for name in placed} == {"Plot", "DiagnosticSummary"}
    assert set(foxglove) == {
        "configById",
        "globalVariables",
        "userNodes",
        "playbackConfig",
        "layout",
    }


def test_every_path_of_foxglove_is_a_number_of_the_bag(foxglove, messages):
    (script,) = foxglove["userNodes"].values()
    source = script["sourceCode"]
    output = re.search(r'output = "(/studio_script/\w+)"', source)[1]
    fields = set(re.findall(r"(\w+): number", source))
    for path in paths(foxglove):
        topic, rest = re.fullmatch(r"([/\w]+)(\..*)", path).groups()
        if topic == output:
            assert rest[1:] in fields
        else:
            assert isinstance(float(along(messages[topic], rest)), float)
    assert {p for p in paths(foxglove) if p.startswith(output)} == {
        f"{output}.{name}" for name in ("w_um", "y_um", "error_nm")
    }
    shown = {p["topicToRender"] for p in foxglove["configById"].values() if "topicToRender" in p}
    assert shown == {"/diagnostics"}


def test_script_of_foxglove_reads_what_the_messages_have(foxglove, messages):
    (script,) = foxglove["userNodes"].values()
    source = script["sourceCode"]
    inputs = json.loads(re.search(r"inputs = (\[.*\])", source)[1])
    assert set(inputs) == {"/pea/displacement", "/pea/reference"} <= set(TYPES)
    for topic in inputs:
        assert f'Input<"{topic}">' in source
        assert hasattr(messages[topic].header.stamp, "sec")
    assert "event.message.position[0]" in source
    along(messages["/pea/displacement"], ".position[0]")
    assert "point.positions[0]" in source
    along(messages["/pea/reference"], ".points[0].positions[0]")
    along(messages["/pea/reference"], ".points[0].time_from_start.sec")


def series(messages: dict[str, Any]) -> set[str]:
    """Names of the curves that PlotJuggler makes of these messages."""
    found = set()
    for topic, message in messages.items():
        for field in ("position", "velocity", "effort"):
            values = getattr(message, field, ())
            found |= {
                f"{topic}/{name}/{field}" for name, _ in zip(getattr(message, "name", ()), values)
            }
        for status in getattr(message, "status", ()):
            start = f"{topic}/{status.hardware_id}/{status.name}"
            found |= {f"{start}/{pair.key}" for pair in status.values}
        for i, point in enumerate(getattr(message, "points", ())):
            found |= {f"{topic}/points[{i}]/positions[{j}]" for j in range(len(point.positions))}
    return found


def test_every_curve_of_plotjuggler_is_a_number_of_the_bag(recorded, messages):
    root = ET.parse(LAYOUTS / "plotjuggler.xml").getroot()
    known = series(messages)
    known |= {
        f"/diagnostics/pea/pea: {node}/rate_hz" for node in ("plant", "observer", "controller")
    }
    known.add("/diagnostics/pea/pea: loop/missed")  # composed in wall time says this
    for snippet in root.iter("snippet"):
        sources = [snippet.findtext("linked_source"), *(v.text for v in snippet.iter("v1"))]
        assert set(sources) <= known
        known.add(snippet.attrib["name"])
    curves = list(root.iter("curve"))
    for curve in curves:
        drawn = [curve.get(axis) for axis in ("curve_x", "curve_y")]
        assert set(drawn if all(drawn) else [curve.attrib["name"]]) <= known
    assert {"/pea/displacement/x/position", "/pea/voltage/x/effort", "/pea/state/x/effort"} <= {
        curve.attrib["name"] for curve in curves
    }


def test_plotjuggler_has_a_place_for_every_plot():
    root = ET.parse(LAYOUTS / "plotjuggler.xml").getroot()
    assert root.tag == "root"
    for splitter in root.iter("DockSplitter"):
        count = int(splitter.attrib["count"])
        sizes = [float(size) for size in splitter.attrib["sizes"].split(";")]
        assert len(splitter) == len(sizes) == count
        assert sum(sizes) == pytest.approx(1.0)
    for area in root.iter("DockArea"):
        (plot,) = area
        assert plot.attrib["mode"] == (
            "XYPlot" if plot.find("curve[@curve_x]") is not None else "TimeSeries"
        )
