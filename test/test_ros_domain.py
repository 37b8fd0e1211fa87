from __future__ import annotations

from pathlib import Path

import pytest
from ros_domain import is_quiet, own_domain

pytest.importorskip("rclpy")
from live_cell import robot_cell


def test_a_domain_is_one_that_nobody_takes_part_in(tmp_path: Path) -> None:
    with robot_cell(tmp_path) as cell:
        domain = int(cell.environment["ROS_DOMAIN_ID"])
        assert not is_quiet(domain)
        with own_domain() as other:
            assert is_quiet(int(other["ROS_DOMAIN_ID"]))
