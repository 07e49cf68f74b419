"""Installs files where ROS 2 looks for them. Named mp4ds-ros, as mp4ds is the Python package."""

from xml.etree import ElementTree

from setuptools import setup

setup(
    name="mp4ds-ros",
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/mp4ds"]),
        ("share/mp4ds", ["package.xml"]),
        ("share/mp4ds/launch", ["launch/play.launch.xml", "launch/record.launch.xml"]),
        ("lib/mp4ds", ["scripts/play", "scripts/record"]),
    ],
)
