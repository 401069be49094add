"""`pip install .`: every package of ros2_ws/src in one distribution, with config/ beside."""

from pathlib import Path

from setuptools import find_packages, setup

SOURCES = Path("ros2_ws/src")
CONFIG = SOURCES / "pea_bringup" / "config"

folders: dict[str, str] = {"": str(SOURCES / "pea_cli")}  # where the module `pea` lies
for source in sorted(SOURCES.iterdir()):
    for name in find_packages(str(source), include=["pea_*"]):
        folders[name] = str(source / name.replace(".", "/"))
data = ["pea_bringup.config"]
data += [f"pea_bringup.config.{each.name}" for each in sorted(CONFIG.iterdir()) if each.is_dir()]
folders["pea_bringup.config"] = str(CONFIG)

setup(
    py_modules=["pea"],
    packages=[*(name for name in folders if name), *data[1:]],
    package_dir=folders,
    package_data={
        "": ["py.typed"],
        "pea_cli": ["skeletons/**/*.in"],
        "pea_native": ["examples/*/*"],
        **{name: ["*"] for name in data},
    },
)
