from setuptools import find_packages, setup

setup(
    name="pea_wire",
    version="0.1.0",
    description="Signals as ROS messages in bytes: topics, codecs, events, diagnostics.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_wire": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_wire"]),
        ("share/pea_wire", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
