from setuptools import find_packages, setup

setup(
    name="pea_ros",
    version="0.1.0",
    description="The shell of a ROS node: transport, parameters, discovery.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_ros": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_ros"]),
        ("share/pea_ros", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
