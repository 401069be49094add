from setuptools import find_packages, setup

setup(
    name="pea_runtime",
    version="0.1.0",
    description="Experiments, the three ways to run the loop, recorder, metrics, report, command line.",
    maintainer="The pea maintainers",
    maintainer_email="pea-maintainers@example.org",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    py_modules=["pea"],
    package_data={"pea_runtime": ["py.typed", "dashboard/static/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pea_runtime"]),
        ("share/pea_runtime", ["package.xml"]),
    ],
    install_requires=["setuptools", "mcap", "nicegui", "rosbags", "zstandard"],
    extras_require={"test": ["pytest", "hypothesis", "mcap-ros2-support", "playwright"]},
    zip_safe=True,
    entry_points={
        "console_scripts": [
            "pea = pea_runtime.__main__:main",
            "recorder = pea_runtime.record.__main__:main",
        ],
        "pea.judge": ["guard = pea_runtime.guard:of_nodes"],
    },
)
