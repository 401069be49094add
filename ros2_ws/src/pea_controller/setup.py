from setuptools import find_packages, setup

setup(
    name="pea_controller",
    version="0.1.0",
    description="Tracking controllers for the piezoelectric actuator.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_controller": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_controller"]),
        ("share/pea_controller", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "hypothesis", "numba", "scipy", "pyyaml"]},
    zip_safe=True,
    entry_points={
        "console_scripts": ["controller = pea_controller.__main__:main"],
        "pea.blocks": ["controller = pea_controller.model:CHOICE"],
    },
)
