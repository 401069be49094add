from setuptools import find_packages, setup

setup(
    name="pea_plant",
    version="0.1.0",
    description="Simulated or real piezoelectric actuator, its amplifier, its sensor, and the safety gate.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_plant": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_plant"]),
        ("share/pea_plant", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "control", "hypothesis", "numba"]},
    zip_safe=True,
    entry_points={
        "console_scripts": ["plant = pea_plant.__main__:main"],
        "pea.blocks": ["plant = pea_plant.plant:Params"],
    },
)
