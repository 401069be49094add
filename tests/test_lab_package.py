"""A package of a lab's own, installed beside ours, adds one model of each kind."""

import json
import os
import subprocess
import sys
import textwrap

import pytest

PROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"

[project]
name = "lab"
version = "1.0"

[tool.setuptools]
packages = ["lab"]
"""

POINTS = {
    "laws": "proportional",
    "observers": "differences",
    "references": "ramp",
    "hysteresis": "backlash",
    "creep": "one",
    "vibration": "stiff",
    "loads": "weight",
    "drivers": "nothing",
}
"""Entry point group to the module that the package installs as ``lab_<module>``."""

MODULES = {
    "proportional": '''
        """u = w/K + k_p e."""

        from dataclasses import dataclass
        from typing import NamedTuple

        from pea_controller.model.common import CommonParams
        from pea_core.params import param

        COMPARED = True

        @dataclass(frozen=True)
        class Params(CommonParams):
            """Proportional."""

            k_p: float = param(1.0, "V/um", 0.0, 100.0, help="gain")

        class Coefficients(NamedTuple):
            K: float
            k_p: float

        class State(NamedTuple):
            u: float

        def design(params, T_s):
            return Coefficients(params.K * 1e-6, params.k_p * 1e6)

        def start(c):
            return State(0.0)

        def output(c, s, W, W_ff, x):
            return W.w / c.K + c.k_p * (W.w - x.x1)

        def update(c, s, W, W_ff, x, u):
            return State(u)

        def equivalent_pid(params):
            return {"K_p_V_per_um": params.k_p}
    ''',
    "differences": '''
        """x2 from the last two samples."""

        from dataclasses import dataclass
        from typing import NamedTuple

        from pea_core.nominal import NominalModel
        from pea_core.signals import Estimate

        KNOWS_EPS = False

        @dataclass(frozen=True)
        class Params(NominalModel):
            """Differences."""

        class Coefficients(NamedTuple):
            T_s: float

        class State(NamedTuple):
            y: float

        def design(params, T_s):
            return Coefficients(T_s)

        def start(c):
            return State(0.0)

        def output(c, s, measured):
            return Estimate(measured.y, (measured.y - s.y) / c.T_s, 0.0)

        def update(c, s, measured, estimate):
            return State(measured.y)
    ''',
    "ramp": '''
        """w = v t."""

        from dataclasses import dataclass
        from typing import NamedTuple

        from pea_core.params import param
        from pea_core.signals import Reference

        @dataclass(frozen=True)
        class Params:
            """Ramp."""

            rate_um_s: float = param(1.0, "um/s", 0.0, 100.0, help="rate", common=True)

        class Coefficients(NamedTuple):
            v: float
            T_s: float

        def design(params, T_s):
            return Coefficients(params.rate_um_s * 1e-6, T_s)

        def output(c, k):
            return Reference(c.v * k * c.T_s, c.v, 0.0)
    ''',
    "backlash": '''
        """v follows u at a distance."""

        from dataclasses import dataclass
        from typing import NamedTuple

        from pea_core.params import param

        @dataclass(frozen=True)
        class Params:
            """One play."""

            width_V: float = param(0.01, "V", 0.0, 10.0, help="half width", fixed=True)

        class Coefficients(NamedTuple):
            r: float

        class State(NamedTuple):
            v: float

        def design(params, T_s):
            return Coefficients(params.width_V)

        def start(c):
            return State(0.0)

        def output(c, s):
            return s.v

        def update(c, s, u):
            return State(max(u - c.r, min(u + c.r, s.v)))
    ''',
    "one": '''
        """One operator."""

        from dataclasses import dataclass

        import numpy as np

        from pea_core.params import param

        @dataclass(frozen=True)
        class Params:
            """One operator."""

            enabled: bool = param(True, help="whether the actuator creeps", fixed=True)

        def operators(params):
            return np.array([1.0]), np.array([0.01])
    ''',
    "stiff": '''
        """Twice the resonance."""

        from dataclasses import dataclass

        import numpy as np

        from pea_core.nominal import NominalModel, state_space
        from pea_plant.model.vibration.late import Delayed

        @dataclass(frozen=True)
        class Params(Delayed):
            """No parameters besides the delay."""

        def continuous(nominal, params):
            return state_space(NominalModel(nominal.zeta, 2.0 * nominal.omega_n, nominal.K))

        def initial(params, x1, x2):
            return np.array([x1, x2])
    ''',
    "weight": '''
        """A load that never changes."""

        from dataclasses import dataclass
        from typing import NamedTuple

        from pea_core.params import param

        @dataclass(frozen=True)
        class Params:
            """One weight."""

            volts: float = param(0.1, "V", -10.0, 10.0, help="volts-equivalent", fixed=True)

        class Coefficients(NamedTuple):
            f_e: float

        def design(params, T_s, K):
            return Coefficients(params.volts)

        def output(c, k):
            return c.f_e
    ''',
    "nothing": '''
        """A device that is never there."""

        from dataclasses import dataclass

        @dataclass(frozen=True)
        class Params:
            """No parameters."""

        def make(plant, T_s):
            raise NotImplementedError
    ''',
    "broken": "raise ValueError('not finished')",
}

CHOSEN = (
    "controller.type=lab_proportional",
    "observer.type=lab_differences",
    "reference.type=lab_ramp",
    "plant.hysteresis.type=lab_backlash",
    "plant.creep.type=lab_one",
    "plant.vibration.type=lab_stiff",
    "plant.load.type=lab_weight",
)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Environment in which the lab's package is installed."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    points = {**POINTS, "laws ": "broken"}
    groups = {}
    for group, module in points.items():
        groups.setdefault(group.strip(), []).append(f'lab_{module} = "lab.{module}"')
    for group, lines in groups.items():
        groups[group] = "\n".join([f'[project.entry-points."pea.{group}"]', *lines])
    (source / "pyproject.toml").write_text(PROJECT + "\n" + "\n".join(groups.values()))
    (source / "lab").mkdir()
    (source / "lab/__init__.py").touch()
    for name, text in MODULES.items():
        (source / f"lab/{name}.py").write_text(textwrap.dedent(text))
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    install += ["--no-build-isolation", "--disable-pip-version-check", "--target", str(target)]
    subprocess.run([*install, str(source)], check=True)
    return {**os.environ, "PYTHONPATH": f"{target}:{os.environ['PYTHONPATH']}"}


def pea(env, *words):
    command = [sys.executable, "-m", "pea_cli.cli", *words]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_each_model_is_listed_and_a_broken_one_with_the_reason(lab):
    found = pea(lab, "list", "--json")
    for title, name in (
        ("controllers", "lab_proportional"),
        ("observers", "lab_differences"),
        ("references", "lab_ramp"),
        ("plants", "hysteresis.type=lab_backlash"),
        ("plants", "creep.type=lab_one"),
        ("plants", "vibration.type=lab_stiff"),
        ("plants", "load.type=lab_weight"),
        ("drivers", "lab_nothing"),
    ):
        assert name in found[title]
    assert found["controllers"]["lab_broken"] == "cannot be used: ValueError: not finished"


def test_all_of_them_run_together_compiled_or_not_to_the_same_bits(lab, tmp_path):
    sets = [word for choice in CHOSEN for word in ("--set", choice)]
    run = ("run", "fig9_hysteresis_10hz", *sets, "--duration", "0.02", "--json", "--force")
    plain = pea({**lab, "PEA_COMPILE": "0"}, *run, "--out", str(tmp_path / "plain"))
    compiled = pea({**lab, "PEA_COMPILE": "1"}, *run, "--out", str(tmp_path / "compiled"))
    assert plain["samples"] == 400
    assert plain["rms_error_nm"] < 100.0
    assert compiled["trace_sha256"] == plain["trace_sha256"]


def test_a_tool_uses_what_a_model_of_a_lab_declares(lab):
    figures = pea(lab, "check", "fig9_hysteresis_10hz", "--set", CHOSEN[0], "--json")
    assert figures["equivalent_pid"] == {"K_p_V_per_um": 1.0}
