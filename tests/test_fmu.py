"""The plant as an FMU: a simulator without pea gets the samples of the plant, to the bit."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pea_core.params import ParameterError
from pea_experiment import experiments
from pea_lab.fmu import write

ROOT = Path(__file__).parents[1]
FMPY = ROOT / ".venv-fmu/bin/python"
N, T_S = 200, 50e-6
U = 20.0 * np.sin(2 * np.pi * 50.0 * np.arange(N + 1) * T_S)
SETS = ["plant.hysteresis.type=prandtl_ishlinskii", "plant.load.type=file"]

BARE = """
import json, sys
sys.path.insert(0, sys.argv[1])
import pea_core
assert pea_core.__file__.startswith(sys.argv[1]), pea_core.__file__
from pea_fmu_plant import Plant
plant = Plant(instance_name="plant", resources=sys.argv[1])
plant.values["K"] = 0.15
plant.exit_initialization_mode()
assert not plant.do_step(0.0, 1.5 * plant.T_s)
found = [list(plant.out.values())]
for k, u in enumerate(json.loads(sys.argv[2])):
    plant.u = u
    assert plant.do_step(k * plant.T_s, plant.T_s)
    found.append(list(plant.out.values()))
print(json.dumps(found))
"""

SIMULATED = """
import json, sys
import numpy as np
from fmpy import simulate_fmu
from fmpy.validation import validate_fmu
file, u, T_s = sys.argv[1], json.loads(sys.argv[2]), 50e-6
assert not validate_fmu(file), validate_fmu(file)
t = np.arange(len(u)) * T_s
given = np.array(list(zip(t, u)), dtype=[("time", float), ("u", float)])
found = simulate_fmu(
    file, stop_time=t[-1], step_size=T_s, output_interval=T_s, input=given,
    output=["y", "u_applied", "x1", "x2"], start_values={"K": 0.15},
)
print(json.dumps([list(row)[1:] for row in found.tolist()]))
"""


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    place = tmp_path_factory.mktemp("fmu")
    (place / "load.csv").write_text("t [s],load [V]\n0,0\n0.002,1.5\n0.004,-1\n")
    sets = [*SETS, f"plant.load.path={place / 'load.csv'}"]
    file = place / "plant.fmu"
    write(file, experiments.load("sine_series", sets))
    (place / "load.csv").rename(place / "gone.csv")
    return file


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """What the plant itself gives."""
    load = tmp_path_factory.mktemp("load") / "load.csv"
    load.write_text("t [s],load [V]\n0,0\n0.002,1.5\n0.004,-1\n")
    sets = [*SETS, f"plant.load.path={load}", "plant.K=0.15"]
    plant = experiments.load("sine_series", sets).plant()
    found = []
    for k in range(N + 1):
        measured, truth = plant.read(), plant.truth
        found.append([measured.y, measured.u_applied, truth.x1, truth.x2])
        plant.write(float(U[k]))
    return found


def run(python, text, *words):
    told = subprocess.run(
        [python, "-I", "-c", text, *words], capture_output=True, text=True, timeout=100, cwd="/"
    )
    assert told.returncode == 0, told.stderr
    return json.loads(told.stdout.splitlines()[-1])


def test_it_holds_all_of_the_model_but_numpy_and_scipy(fmu, samples, tmp_path):
    zipfile.ZipFile(fmu).extractall(tmp_path)
    given = json.dumps(U[:-1].tolist())
    assert run(sys.executable, BARE, str(tmp_path / "resources"), given) == samples


@pytest.mark.skipif(not FMPY.exists(), reason="FMPy is not there: .ci/beside fmu makes it")
def test_another_simulator_reads_it(fmu, samples):
    assert run(str(FMPY), SIMULATED, str(fmu), json.dumps(U.tolist())) == samples


@pytest.mark.parametrize(
    ("name", "words"),
    [("plant.zip", "ends in .fmu"), ("none/plant.fmu", "no directory"), ("old.fmu", "exists")],
)
def test_another_name_is_refused(name, words, tmp_path):
    (tmp_path / "old.fmu").touch()
    with pytest.raises(ParameterError, match=words):
        write(tmp_path / name, experiments.load("sine_series", []))
