"""Built by colcon; `aqualvs` itself comes from pip."""

from setuptools import setup

NAME = "aqualvs_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/aqualvs.launch.py"]),
        (f"share/{NAME}/config", ["config/aqualvs.yaml"]),
        (f"share/{NAME}/rviz", ["rviz/aqualvs.rviz"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="aqualvs developers",
    maintainer_email="aqualvs@users.noreply.github.com",
    description="Underwater laser vision as a ROS 2 node.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"live = {NAME}.node:main"]},
)
