"""The ROS 2 package of the action server; lungaccess itself is installed by pip."""

from setuptools import setup

NAME = "lungaccess_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools", "lungaccess"],
    entry_points={"console_scripts": ["server = lungaccess_ros.server:main"]},
)
