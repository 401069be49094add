"""`pip install .`: what needs no ROS runs without it, and what needs it says so in one line."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).parents[1]
HIDDEN = ("rclpy", "ament_index_python", "domain_coordinator", "nicegui", "uvicorn")
HIDDEN += ("xarray", "caproto", "pythonfmu")
WITHOUT = f"""
import sys
sys.modules.update(dict.fromkeys({HIDDEN!r}))
from pea_cli.__main__ import main
sys.exit(main())
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The distribution, built from a copy of the sources: building writes beside them."""
    there = tmp_path_factory.mktemp("wheel")
    source = there / "source"
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info", "test")
    shutil.copytree(ROOT / "ros2_ws" / "src", source / "ros2_ws" / "src", ignore=ignored)
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = ("wheel", "--quiet", "--no-deps", "--no-index", "--no-build-isolation")
    subprocess.run(
        [sys.executable, "-m", "pip", *build, "--wheel-dir", str(there), str(source)], check=True
    )
    (found,) = there.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Folder that holds it, and nothing of the workspace."""
    there = tmp_path_factory.mktemp("site")
    with ZipFile(wheel) as archive:
        archive.extractall(there)
    return there


def pea(installed, there, *words):
    """Run the command, without ROS, from another folder."""
    keep = ("PATH", "LANG", "LC_ALL", "NUMBA_CACHE_DIR")
    env = {name: os.environ[name] for name in keep if name in os.environ}
    env |= {"HOME": str(there), "PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-c", WITHOUT, *words]
    return subprocess.run(command, cwd=there, env=env, capture_output=True, text=True, timeout=100)


def test_the_wheel_says_what_it_is(wheel):
    with ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = [name for name in names if name.endswith("/METADATA")]
        said = Parser().parsestr(archive.read(metadata).decode())
        (points,) = [name for name in names if name.endswith("/entry_points.txt")]
        assert "pea = pea_cli.__main__:main" in archive.read(points).decode()
    assert said["Name"] == "pea"
    assert said["License-Expression"] == "Apache-2.0"
    assert set(said.get_all("Provides-Extra")) == {
        "ros",
        "dashboard",
        "cluster",
        "data",
        "epics",
        "fmu",
    }
    assert "pea.py" in names
    packages = {path.parent.name for path in (ROOT / "ros2_ws/src").glob("*/package.xml")}
    assert packages <= {name.split("/")[0] for name in names}
    config = {str(path.relative_to(ROOT / "config")) for path in (ROOT / "config").rglob("*.*")}
    start = "pea_bringup/config/"
    assert {name.removeprefix(start) for name in names if name.startswith(start)} == config
    assert not [name for name in names if "/test/" in name or re.search(r"test_\w+\.py$", name)]


def test_it_runs_without_ros(installed, tmp_path):
    run = pea(installed, tmp_path, "run", "fig9_hysteresis_10hz", "--duration", "0.2", "--json")
    assert run.returncode == 0, run.stderr
    again = pea(installed, tmp_path, "replay", "runs/latest")
    assert again.returncode == 0, again.stderr
    assert "the same to the bit" in again.stdout
    export = pea(installed, tmp_path, "export", "runs/latest", "--netcdf", "run.nc")
    assert export.returncode == 2
    assert "pip install '.[data]'" in export.stderr
    assert not (tmp_path / "run.nc").exists()
    made = pea(installed, tmp_path, "new", "law", "my_law")
    assert made.returncode == 0, made.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "fig9_hysteresis_10hz", "--mode", "composed"), "pip install '.[ros]'"),
        (("run", "fig9_hysteresis_10hz", "--mode", "distributed"), "pip install '.[ros]'"),
        (("dashboard",), "is missing: python3 -m pip install '.["),
        (("bridge", "epics"), "is missing: python3 -m pip install '.["),
        (("fmu", "sine_series", "--out", "a.fmu"), "pip install '.[fmu]'"),
        (("bench",), "run ./pea bench in a checkout"),
    ],
)
def test_what_is_missing_is_one_line_that_names_the_extra(installed, tmp_path, words, says):
    ended = pea(installed, tmp_path, *words)
    assert ended.returncode in (2, 3)
    last = ended.stderr.splitlines()[-1]
    assert last.startswith("pea: ")
    assert says in last
    assert "Traceback" not in ended.stderr
