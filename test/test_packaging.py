from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import Distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Distribution:
    """What setup.py tells pip and colcon."""
    folder = tmp_path_factory.mktemp("egg")
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return Distribution.at(folder / "fewcal.egg-info")


@pytest.fixture(scope="module")
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def requirements(package: Distribution) -> list[Requirement]:
    return [Requirement(text) for text in package.requires or []]


def test_the_versions_agree(package: Distribution, manifest: ElementTree.Element) -> None:
    assert package.metadata["Name"] == manifest.findtext("name") == "fewcal"
    assert package.version == manifest.findtext("version")
    releases = re.findall(r"^(\d+\.\d+\.\d+) \(.*\)\n-+$", (ROOT / "CHANGELOG.rst").read_text(), re.MULTILINE)
    assert releases[0] == package.version


def test_the_manifest_is_that_of_an_ament_python_package(manifest: ElementTree.Element) -> None:
    assert manifest.get("format") == "3"
    assert manifest.findtext("export/build_type") == "ament_python"
    assert manifest.findtext("license") == "Apache-2.0"
    assert (ROOT / "LICENSE").read_text().split()[:2] == ["Apache", "License"]


def test_every_dependency_has_a_lower_and_an_upper_bound(package: Distribution) -> None:
    assert requirements(package)
    for requirement in requirements(package):
        assert sorted(s.operator for s in requirement.specifier) == ["<", ">="], str(requirement)


def test_the_oldest_versions_that_are_tested_are_the_lower_bounds(package: Distribution) -> None:
    lines = (ROOT / "constraints-oldest.txt").read_text().splitlines()
    oldest = dict(line.split("==") for line in lines if not line.startswith("#"))
    lower = {
        requirement.name: next(s.version for s in requirement.specifier if s.operator == ">=")
        for requirement in requirements(package)
        if requirement.marker is None
    }
    assert oldest.keys() == lower.keys()
    for name, version in oldest.items():
        asked = Version(lower[name]).release
        assert Version(version).release[: len(asked)] == asked, name


def test_what_a_ros_machine_is_told_to_install_is_what_pip_installs(
    package: Distribution, manifest: ElementTree.Element
) -> None:
    rosdep = {"opencv-python-headless": "python3-opencv", "PyYAML": "python3-yaml"}
    rosdep |= {name: f"python3-{name}-pip" for name in ("mcap", "rosbags")}
    by_mcap = {"lz4", "zstandard"}  # mcap itself depends on them, and they have no rosdep keys
    names = {r.name for r in requirements(package) if r.marker is None} - by_mcap
    expected = {rosdep.get(name, f"python3-{name}") for name in names}
    assert {element.text for element in manifest.iter("exec_depend")} >= expected


@pytest.mark.skipif(importlib.util.find_spec("colcon_core") is None, reason="colcon is not installed")
def test_colcon_builds_and_the_command_runs_from_its_install_space(tmp_path: Path) -> None:
    # What a developer has sourced or set must not stand in for what colcon installs.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("COLCON", "AMENT", "PYTHON"))}
    environment["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), environment["PATH"]])

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(sys.executable, "-m", "colcon", "build", "--base-paths", str(ROOT))
    prefix = tmp_path / "install" / "fewcal"
    library = next(prefix.glob("lib/python3*/site-packages"))
    assert (prefix / "share/fewcal/package.xml").read_text() == (ROOT / "package.xml").read_text()
    assert (prefix / "share/ament_index/resource_index/packages/fewcal").is_file()
    for folder in ("launch", "config"):
        installed = {path.name for path in (prefix / "share/fewcal" / folder).iterdir()}
        assert installed == {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
    for package in ("fewcal", "fewcal_ros"):
        sources = {path.name for path in (ROOT / package).iterdir() if path.suffix in (".py", ".typed")}
        assert {path.name for path in (library / package).iterdir()} >= sources
    where = run("bash", "-c", '. install/setup.sh && python3 -c "import fewcal; print(fewcal.__file__)"')
    assert where.startswith(str(library))
    assert "calibrate" in run("bash", "-c", ". install/setup.sh && install/fewcal/lib/fewcal/fewcal --help")
