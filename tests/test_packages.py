"""Every package says what it is and what it may import, and holds one concept."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(p for p in (ROOT / "ros2_ws/src").iterdir() if (p / "package.xml").exists())
LINES_MAX = 5000
ORIGIN = ROOT / "ros2_ws/src/pea_record/pea_record/origin.py"


def modules(package):
    return (package / package.name).rglob("*.py")


def imported(package):
    found = set()
    for path in modules(package):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                found.add(node.module.partition(".")[0])
            elif isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
    return found


@pytest.fixture(params=PACKAGES, ids=lambda p: p.name)
def package(request):
    return request.param


def test_it_says_what_it_may_import_at_its_head_and_in_its_description(package):
    described = re.search(
        r"<description>.*(May import: [^<]+?)\.?</description>",
        (package / "package.xml").read_text(),
    )
    assert described
    head = ast.get_docstring(ast.parse((package / package.name / "__init__.py").read_text()))
    assert described[1] in " ".join(head.split())


def test_it_depends_on_every_package_of_ours_that_it_imports(package):
    ours = {p.name for p in PACKAGES} & imported(package) - {package.name}
    declared = re.findall(r"<exec_depend>(\w+)<", (package / "package.xml").read_text())
    assert ours <= set(declared)


def test_it_has_at_most_5000_lines_that_are_not_blank(package):
    texts = [path.read_text().split("\n") for path in modules(package)]
    assert sum(bool(line.strip()) for text in texts for line in text) <= LINES_MAX


def test_every_package_has_a_floor_and_no_rule_has_an_exception():
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    floors = next(c for c in rules["contracts"] if c["type"] == "layers")["layers"]
    names = {name.strip() for floor in floors for name in floor.split("|")}
    assert names == {p.name for p in PACKAGES} - {"pea_bringup"}
    assert not any("ignore_imports" in contract for contract in rules["contracts"])


def test_nothing_of_the_bench_is_installed():
    assert not any("pea_bench" in path.parts for p in PACKAGES for path in p.rglob("*.py"))


def test_it_has_the_one_version_and_a_changelog_of_it(package):
    version = re.search(r'^VERSION = "(.*)"', ORIGIN.read_text(), re.MULTILINE)[1]
    assert f"<version>{version}</version>" in (package / "package.xml").read_text()
    assert f'version="{version}"' in (package / "setup.py").read_text()
    log = (package / "CHANGELOG.rst").read_text().splitlines()
    assert log[1] == f"Changelog for package {package.name}"
    assert log[4].startswith(f"{version} (")
    assert len(log[5]) >= len(log[4])
