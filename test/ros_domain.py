"""A ROS domain for one test alone, however many run at the same time on this machine."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_DOMAINS = range(1, 100)
"""Beyond 101 the ports of a domain lie among those that the system hands out to anybody."""
_PARTICIPANTS = range(10)
"""Those looked for: a participant takes the first number that is free."""


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
            if not is_quiet(domain):
                continue
            yield {
                **os.environ,
                "ROS_DOMAIN_ID": str(domain),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            }
            return
    raise RuntimeError("All ROS domains are taken by other tests.")


def is_quiet(domain: int) -> bool:
    """Whether nobody takes part in a domain on this host: a robot that runs here, or what a test left behind.

    A participant listens to others on the port 7410 + 250 domain + 2 participant (DDSI-RTPS, 9.6.2).
    """
    for participant in _PARTICIPANTS:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
            try:
                port.bind(("", 7410 + 250 * domain + 2 * participant))
            except OSError:
                return False
    return True
