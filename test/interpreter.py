"""A fresh Python, for what happens while a command is imported or ends."""

from __future__ import annotations

import subprocess
import sys

IMPORT_THAT_IS_INTERRUPTED = """
import os, sys, types
class Module(types.ModuleType):
    def __getattr__(self, name):
        os.kill(os.getpid(), {number})
        raise AttributeError(name)
sys.modules['{module}'] = Module('{module}')
from {command} import main
sys.exit(main())
"""
"""Runs a command; the module that it imports is taken by one that sends the signal."""


def run_python(code: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stdout, done.stderr
