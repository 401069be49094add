from setuptools import find_packages, setup

setup(
    name="pea_engine",
    version="0.1.0",
    description="The loop compiled and in wall time: kernels, lanes, pacing.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_engine": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_engine"]),
        ("share/pea_engine", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
