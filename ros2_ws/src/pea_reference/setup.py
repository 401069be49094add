from setuptools import find_packages, setup

setup(
    name="pea_reference",
    version="0.1.0",
    description="Desired displacement and its exact derivatives.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_reference": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_reference"]),
        ("share/pea_reference", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest", "hypothesis", "numba"]},
    zip_safe=True,
    entry_points={
        "console_scripts": ["reference = pea_reference.__main__:main"],
        "pea.blocks": ["reference = pea_reference.model:CHOICE"],
    },
)
