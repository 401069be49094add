"""The lock files: product, tools and tests apart, and nothing in them that nobody needs."""

import ast
import re
import subprocess
import tomllib
from importlib import metadata
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
BUILDS = {"colcon-core", "colcon-output", "colcon-parallel-executor", "colcon-recursive-crawl"}
BUILDS |= {"colcon-python-setup-py", "colcon-ros", "colcon-bash", "colcon-zsh", "setuptools", "uv"}
CHECKS = {"ruff", "mypy", "import-linter"}
DOCS = {"mkdocs-material", "mkdocstrings[python]", "latex2mathml"}
TESTS = {"pytest", "pytest-timeout", "pytest-xdist", "pytest-rerunfailures", "playwright"}
TESTS |= {"ipykernel"}  # notebooks name it as their kernel
BY_NAME = {"h11", "websockets", "h5netcdf"}  # uvicorn and xarray import them by name
META = {"ros-jazzy-rclpy", "ros-jazzy-common-interfaces", "ros-jazzy-domain-coordinator"}


def same(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(part):
    lines = (ROOT / f"requirements{part}.lock").read_text().splitlines()
    return {same(re.split(r"[\[=]", line)[0]) for line in lines if not line.startswith("#")}


def declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [*project["dependencies"], *chain(*project["optional-dependencies"].values())]


def needed(roots):
    """Distributions that `roots` are, and need."""
    found, asked, done = set(), [Requirement(root) for root in roots], set()
    while asked:
        one = asked.pop()
        key = same(one.name), frozenset(one.extras)
        if key in done:
            continue
        done.add(key)
        found.add(same(one.name))
        for text in metadata.distribution(one.name).requires or ():
            inner = Requirement(text)
            extras = one.extras or {""}
            if not inner.marker or any(inner.marker.evaluate({"extra": e}) for e in extras):
                asked.append(inner)
    return found


def imported(chosen):
    """Distributions that the files of the repository import, where `chosen` says so."""
    files = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    modules = set()
    for path in filter(chosen, files.stdout.split()):
        for node in ast.walk(ast.parse((ROOT / path).read_text())):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                modules.add(node.module.partition(".")[0])
    of = metadata.packages_distributions()
    names = {same(name) for module in modules for name in of.get(module, ())}
    ours = {path.parent.name for path in (ROOT / "ros2_ws/src").glob("*/package.xml")}
    return {name for name in names if f"ros-{name}" not in names} - set(map(same, ours))


def is_product(path):
    return path.startswith("ros2_ws/src/") and "/test/" not in path and "setup.py" not in path


@pytest.fixture(autouse=True)
def wheels():
    try:
        metadata.distribution("ros-jazzy-rclpy")
    except metadata.PackageNotFoundError:
        pytest.skip("the ROS of the system is used: its packages are not locked")


def test_the_distribution_declares_what_it_imports_and_nothing_else():
    found = imported(is_product)
    roots = {same(Requirement(text).name) for text in declared()}
    assert roots - META - BY_NAME <= found
    assert found - needed(META) <= roots


def test_the_products_lock_holds_what_the_product_needs():
    assert locked("") == needed(declared())


def test_the_tools_lock_holds_what_builds_and_checks():
    assert locked("-tools") == needed(BUILDS | CHECKS | DOCS) - locked("") - locked("-tests")


def test_the_tests_lock_holds_what_the_tests_import():
    roots = imported(lambda path: not is_product(path)) - locked("") - locked("-tools")
    assert roots <= locked("-tests")
    assert locked("-tests") <= needed(TESTS | META | roots | {"colcon-core"})  # it asks for pytest
