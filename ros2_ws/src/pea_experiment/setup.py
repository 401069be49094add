from setuptools import find_packages, setup

setup(
    name="pea_experiment",
    version="0.1.0",
    description="An experiment: its file, its blocks, its rig, its score.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_experiment": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_experiment"]),
        ("share/pea_experiment", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
