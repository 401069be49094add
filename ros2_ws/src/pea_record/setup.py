from setuptools import find_packages, setup

setup(
    name="pea_record",
    version="0.1.0",
    description="Recordings: write, read, recover, cut, export MCAP.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_record": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_record"]),
        ("share/pea_record", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
