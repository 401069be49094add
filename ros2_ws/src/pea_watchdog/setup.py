from setuptools import find_packages, setup

setup(
    name="pea_watchdog",
    version="0.1.0",
    description="A process that brings the amplifier to its safe voltage when the plant cannot.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_watchdog": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_watchdog"]),
        ("share/pea_watchdog", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
