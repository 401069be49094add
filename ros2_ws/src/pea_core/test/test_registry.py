import dataclasses
import sys
from importlib.metadata import EntryPoint, EntryPoints
from types import ModuleType

import pytest

from pea_core import registry
from pea_core.params import ParameterError, build
from pea_core.registry import BROKEN, models

GROUP = "pea.things"


def module(monkeypatch, name, **offers):
    made = ModuleType(name)
    made.__dict__.update({"Params": dataclasses.make_dataclass("Params", ()), **offers})
    monkeypatch.setitem(sys.modules, name, made)
    return made


@pytest.fixture
def install(monkeypatch):
    """Entry points that a lab's packages have."""
    points = []
    monkeypatch.setattr(registry, "points", lambda: EntryPoints(points))
    monkeypatch.delitem(BROKEN, GROUP, raising=False)
    return lambda name, value: points.append(EntryPoint(name, value, GROUP))


def test_a_model_of_a_lab_comes_after_ours(install, monkeypatch):
    ours, theirs = module(monkeypatch, "ours"), module(monkeypatch, "lab_law", design=len)
    install("lab", "lab_law")
    assert models(GROUP, {"own": ours}, ("design",)) == {"own": ours, "lab": theirs}


def test_a_broken_model_is_left_out_with_the_reason(install, monkeypatch):
    module(monkeypatch, "lab_law", design=len)
    install("missing", "no_such_module_at_all")
    install("short", "lab_law")
    assert models(GROUP, {}, ("design", "update")) == {}
    assert "no_such_module_at_all" in BROKEN[GROUP]["missing"]
    assert BROKEN[GROUP]["short"] == "AttributeError: lab_law lacks update"


def test_who_chooses_a_broken_model_reads_the_reason(install, monkeypatch):
    install("missing", "no_such_module_at_all")
    choice = registry.registry(
        GROUP, models(GROUP, {"own": module(monkeypatch, "ours")}, ()), "own", "things"
    )
    with pytest.raises(ParameterError, match=r"type = 'missing': cannot be used: .*no_such_module"):
        build(choice, {"type": "missing"})


def test_who_chooses_a_name_of_ours_that_a_lab_has_too_reads_both(install, monkeypatch):
    ours, _ = module(monkeypatch, "ours"), module(monkeypatch, "lab_law")
    install("own", "lab_law")
    choice = registry.registry(GROUP, models(GROUP, {"own": ours}, ()), "own", "things")
    with pytest.raises(ParameterError, match="'own': cannot be used: ours and lab_law both have"):
        build(choice, {"type": "own"})
    assert isinstance(build(choice, {}), ours.Params)


def test_who_chooses_a_name_that_two_packages_of_a_lab_have_reads_both(install, monkeypatch):
    module(monkeypatch, "first"), module(monkeypatch, "second")
    install("same", "first")
    install("same", "second")
    install("once", "first")
    models(GROUP, {}, ())
    assert BROKEN[GROUP].keys() == {"same"}
    assert BROKEN[GROUP]["same"].startswith("first and second both have this name")


def test_a_model_that_is_installed_twice_can_be_chosen(install, monkeypatch):
    ours = module(monkeypatch, "ours")
    install("own", "ours")
    install("own", "ours")
    choice = registry.registry(GROUP, models(GROUP, {"own": ours}, ()), "own", "things")
    assert isinstance(build(choice, {"type": "own"}), ours.Params)


def test_the_first_package_goes_before_all_others_and_must_work(install, monkeypatch):
    theirs, ours = module(monkeypatch, "lab.gcs"), module(monkeypatch, "pea_first.gcs")
    install("gcs", "lab.gcs")
    install("gcs", "pea_first.gcs")
    assert models(GROUP, {}, (), first="pea_first") == {"gcs": ours} != {"gcs": theirs}
    install("nv200", "pea_first.no_such_module")
    with pytest.raises(ModuleNotFoundError):
        models(GROUP, {}, (), first="pea_first")
