from setuptools import find_packages, setup

setup(
    name="pea_drivers",
    version="0.1.0",
    description="Drivers of real amplifiers and sensors, each with the emulated device it is rehearsed on.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_drivers": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_drivers"]),
        ("share/pea_drivers", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={
        "pea.drivers": [
            "gcs = pea_drivers.gcs",
            "modbus_daq = pea_drivers.modbus_daq",
            "nv200 = pea_drivers.nv200",
        ]
    },
)
