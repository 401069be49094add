from setuptools import find_packages, setup

setup(
    name="pea_report",
    version="0.1.0",
    description="What a recording shows: replay, figures, pages.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_report": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_report"]),
        ("share/pea_report", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
