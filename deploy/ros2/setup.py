"""What colcon builds; qsgm itself is installed by pip."""

from pathlib import Path

from setuptools import setup

NAME = "qsgm_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="Teach an object from one camera image and find it in those that follow",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", [str(one) for one in Path("launch").glob("*.launch.py")]),
        (f"share/{NAME}/config", [str(one) for one in Path("config").glob("*.yaml")]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={"console_scripts": [f"finder = {NAME}.node:main"]},
)
