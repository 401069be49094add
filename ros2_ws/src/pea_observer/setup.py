from setuptools import find_packages, setup

setup(
    name="pea_observer",
    version="0.1.0",
    description="State observers for the piezoelectric actuator.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_observer": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_observer"]),
        ("share/pea_observer", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "control", "hypothesis", "numba"]},
    zip_safe=True,
    entry_points={
        "console_scripts": ["observer = pea_observer.__main__:main"],
        "pea.blocks": ["observer = pea_observer.model:CHOICE"],
    },
)
