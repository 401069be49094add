from setuptools import find_packages, setup

setup(
    name="pea_identify",
    version="0.1.0",
    description="Identification of a stage from measured voltages and displacements.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_identify": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_identify"]),
        ("share/pea_identify", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "control"]},
    zip_safe=True,
)
