from __future__ import annotations

import os
import subprocess
import sys

from fewcal_ros.threads import SINGLE_THREAD

NAME, VALUE = SINGLE_THREAD


def outcome(code: str, **environment: str) -> str:
    others = {name: value for name, value in os.environ.items() if name != NAME}
    return subprocess.check_output([sys.executable, "-c", code], env=others | environment, text=True).strip()


def test_the_command_sets_it_before_numpy_is_there() -> None:
    code = (
        "import os, sys, fewcal_ros.threads; early = 'numpy' in sys.modules; import fewcal_ros.cli; "
        f"print(early, os.environ[{NAME!r}])"
    )
    assert outcome(code) == f"False {VALUE}"


def test_who_has_set_it_is_not_overruled() -> None:
    assert outcome(f"import os, fewcal_ros.cli; print(os.environ[{NAME!r}])", **{NAME: "3"}) == "3"
