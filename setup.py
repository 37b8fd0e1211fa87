"""The package `fewcal`, for pip and for colcon (ament_python).

Lower bounds are the versions that Ubuntu 24.04 and so ROS 2 Jazzy ship, or the oldest that has what is used;
`make test-oldest` runs the suite on them. Upper bounds stop at the next major version, which may break.
"""

from pathlib import Path

from setuptools import setup

PACKAGE = "fewcal"
VERSION = "0.1.0"  # package.xml and CHANGELOG.rst say the same; test/test_packaging.py holds them together

setup(
    name=PACKAGE,
    version=VERSION,
    description="Camera calibration from one or two views of a board, with honest error bars, for ROS 2",
    long_description=Path(__file__).with_name("README.md").read_text("utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    author="The fewcal maintainers",
    maintainer="The fewcal maintainers",
    packages=["fewcal", "fewcal_ros"],
    package_data={"fewcal": ["py.typed"], "fewcal_ros": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/fewcal"]),
        ("share/fewcal", ["package.xml"]),
        ("share/fewcal/launch", ["launch/fewcal.launch.py"]),
        ("share/fewcal/config", sorted(str(path) for path in Path("config").iterdir())),
    ],
    zip_safe=False,
    python_requires=">=3.10",
    install_requires=[
        "numpy>=1.26,<3",
        "scipy>=1.11,<2",
        "opencv-python-headless>=4.6,<6",
        "PyYAML>=6.0.1,<7",
        "rich>=13.7,<16",
        "rosbags>=0.11,<0.12",  # before 1.0 every minor version may change its interface
        "mcap>=1.2,<2",
        "lz4>=4.3.3,<5",
        "zstandard>=0.22,<1",
    ],
    extras_require={
        "ros": [
            "ros-jazzy-rclpy>=7.1,<8",
            "ros-jazzy-common-interfaces>=5.3,<6",
            "ros-jazzy-rmw-fastrtps-cpp>=8.4,<9",
        ],
        "experiments": ["matplotlib>=3.6,<4"],  # the figures of experiments/ and doc/
        "test": [
            "pytest>=8,<10",
            "pytest-xdist>=3.6,<4",
            "hypothesis>=6.100,<7",
            "mypy>=1.15,<3",
            "ruff>=0.17,<0.18",  # every minor version may format otherwise
            "scipy-stubs>=1.14,<2",
            "types-PyYAML>=6.0.12,<7",
            "colcon-common-extensions>=0.3,<0.4",
            "pypdfium2>=4.30,<6",  # this and the next rasterise what is printed
            "resvg-py>=0.2,<1",
        ],
    },
    entry_points={
        "console_scripts": ["fewcal = fewcal_ros.command:main", "fewcal_node = fewcal_ros.node_command:main"]
    },
)
