from setuptools import find_packages, setup

setup(
    name="pea_lab",
    version="0.1.0",
    description="Theory and simulation of experiments: linear analysis, margins, tuning, sweeps, comparison.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_lab": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_lab"]),
        ("share/pea_lab", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"pea.judge": ["guard = pea_lab.guard:of_nodes"]},
)
