from setuptools import find_packages, setup

setup(
    name="pea_dashboard",
    version="0.1.0",
    description="The page in the browser: watch, tune, stop.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"pea_dashboard": ["py.typed", "static/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_dashboard"]),
        ("share/pea_dashboard", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
)
