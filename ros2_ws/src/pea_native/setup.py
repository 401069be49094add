from setuptools import find_packages, setup

setup(
    name="pea_native",
    version="0.1.0",
    description="Compiled drivers, called from the compiled loop, and boards that stand for devices.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_native": ["py.typed", "examples/*/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_native"]),
        ("share/pea_native", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={
        "pea.drivers": [
            "comedi = pea_native.comedi",
            "native = pea_native.native",
            "registers = pea_native.registers",
            "udp = pea_native.udp",
        ]
    },
)
