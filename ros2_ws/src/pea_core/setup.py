from setuptools import find_packages, setup

setup(
    name="pea_core",
    version="0.1.0",
    description="Contracts of the control loop: blocks, signals, parameters, the loop itself.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_core": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_core"]),
        ("share/pea_core", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
