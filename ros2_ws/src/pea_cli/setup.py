from setuptools import find_packages, setup

setup(
    name="pea_cli",
    version="0.1.0",
    description="The command pea: one module a command, nothing computed.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_cli": ["py.typed", "skeletons/**/*.in"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_cli"]),
        ("share/pea_cli", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    py_modules=["pea"],
    entry_points={"console_scripts": ["pea = pea_cli.__main__:main"]},
)
