from setuptools import find_packages, setup

setup(
    name="pea_measure",
    version="0.1.0",
    description="Measurements of a stage and of its running loop: what is driven, and what it shows.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_measure": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_measure"]),
        ("share/pea_measure", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
