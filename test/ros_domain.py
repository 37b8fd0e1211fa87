"""A ROS domain for one test alone, however many run at the same time on this machine."""

from __future__ import annotations

import fcntl
import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_DOMAINS = range(1, 100)
"""Beyond 101 the ports of a domain lie among those that the system hands out to anybody."""


@contextmanager
def own_domain() -> Iterator[dict[str, str]]:
    """Environment of the processes of a test: a domain nobody else here has, and nothing beyond this host."""
    folder = Path(tempfile.gettempdir(), f"fewcal-domains-{os.getuid()}")
    folder.mkdir(exist_ok=True)
    # At random, so that what a test that ends hard leaves in shared memory does not meet the very next one.
    for domain in random.sample(_DOMAINS, len(_DOMAINS)):
        with (folder / str(domain)).open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield {
                **os.environ,
                "ROS_DOMAIN_ID": str(domain),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            }
            return
    raise RuntimeError("All ROS domains are taken by other tests.")
