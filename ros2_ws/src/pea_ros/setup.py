from setuptools import find_packages, setup

setup(
    name="pea_ros",
    version="0.1.0",
    description="Everything of pea that knows rclpy: topics, parameters, the node shell.",
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
    extras_require={"test": ["pytest", "hypothesis", "rosbags"]},
    zip_safe=True,
)
