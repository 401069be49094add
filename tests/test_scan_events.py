"""Events of a scan in the recording of every mode."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from pea_core.config import BATCH, COMPOSED, DISTRIBUTED
from pea_record.read import load
from pea_reference.model import raster
from pea_wire import scanning
from pea_wire.topics import EVENTS

VALUES = {"lines": 2, "pixels": 4, "line_rate_hz": 40.0, "flyback_lines": 1}
SHORT = (
    "fig9_hysteresis_10hz", "--duration", "0.1", "--set", "reference.type=raster",
    "--set", "plant.stage.specimen=exp(-x)",
    *(word for n, v in VALUES.items() for word in ("--set", f"reference.{n}={v}")),
)  # fmt: skip


@pytest.mark.parametrize("mode", [BATCH, COMPOSED, DISTRIBUTED])
def test_the_recording_has_every_event_once(recorded, mode):
    run = recorded(mode, *SHORT)
    tables = []
    with AnyReader([run.directory]) as reader:
        for connection, time, data in reader.messages():
            if connection.topic == EVENTS.name:
                tables.append(scanning.decode(bytes(data)))
                assert time == tables[-1][0, 0]
    found = np.concatenate(tables)
    wanted = raster.events(raster.Params(**VALUES), 50e-6, 0, 2000)
    assert found[:, 0].tolist() == (wanted["k"] * 50_000).tolist()
    for i, name in enumerate(scanning.COLUMNS[1:], 1):
        assert found[:, i].tolist() == wanted[name].tolist()
    assert len(wanted) > 20


@pytest.mark.parametrize("mode", [BATCH, COMPOSED, DISTRIBUTED])
def test_the_recording_has_the_sample_signal_of_every_sample(recorded, mode):
    recording = load(recorded(mode, *SHORT).directory)
    assert len(recording.samples) == 2000
    np.testing.assert_allclose(recording.signal, np.exp(-1e6 * recording.samples["y"]), rtol=1e-9)
    batch = load(recorded(BATCH, *SHORT).directory)
    assert recording.signal.tobytes() == batch.signal.tobytes()
