from setuptools import find_packages, setup

setup(
    name="pea_run",
    version="0.1.0",
    description="An experiment made to run: the three modes, recorder, player, doctor.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_run": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_run"]),
        ("share/pea_run", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": ["recorder = pea_run.recorder.__main__:main"]},
)
