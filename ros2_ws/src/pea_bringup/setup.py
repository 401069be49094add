from setuptools import find_packages, setup

setup(
    name="pea_bringup",
    version="0.1.0",
    description="Configuration and launch files of pea.",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_bringup": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_bringup"]),
        ("share/pea_bringup", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=True,
    entry_points={"console_scripts": []},
)
