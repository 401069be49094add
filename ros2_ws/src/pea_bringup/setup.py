import os
from glob import glob

from setuptools import find_packages, setup

CONFIG = "config"


def files(folder, pattern):
    """Install the files of a folder of config/ under the same name."""
    there = os.path.join("share/pea_bringup/config", folder)
    return (there, sorted(glob(os.path.join(CONFIG, folder, pattern))))


setup(
    name="pea_bringup",
    version="0.1.0",
    description="Configuration and launch files of pea.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_bringup"]),
        ("share/pea_bringup", ["package.xml"]),
        ("share/pea_bringup/launch", sorted(glob("launch/*.launch.py"))),
        files("", "*.xml"),
        files("experiments", "*.yaml"),
        files("plants", "*.yaml"),
        files("observers", "*.yaml"),
        files("controllers", "*.yaml"),
        files("rigs", "*.yaml"),
        files("layouts", "*.*"),
        files("security", "*.xml"),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
