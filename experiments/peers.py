"""Other rod codes on rodjax's problems: the same physics, each by its own means, timed alike.

outcome = run(peer, scene, elements, dt)
"""

from collections.abc import Callable
from typing import Any

from peer_dismech import run_dismech
from peer_problems import PROBLEMS, CannotRun, Outcome
from peer_pyelastica import run_pyelastica

PEERS: dict[str, Callable[[Any, int, float], Outcome | CannotRun]] = {
    "pyelastica": run_pyelastica,
    "dismech-newton": run_dismech,
}


def run(peer: str, scene: str, elements: int, dt: float) -> Outcome | CannotRun:
    """A problem by a peer: `elements` of equal length, steps of `dt` [s]."""
    return PEERS[peer](PROBLEMS[scene], elements, dt)
