"""The other codes of `peers.py` as methods of `error_vs_runtime.py`.

A peer gives positions at the times asked for and at equally spaced points, and times its own warm
run. Its problem must be the one that has the same name in `runtime_scenes`, the times apart.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from runtime_methods import CannotRun, Case, Measured, Outcome
from runtime_scenes import POINTS, Problem, Record

# Explicit steps just below the stability limit of the shear mode, 2 / sqrt(k G A_c / (rho I)) =
# 88 us for D = 10 mm, and of axial waves on the grid; larger steps only fail.
EXPLICIT_STEP = 5e-5
EXPLICIT = ("pyelastica",)


@dataclasses.dataclass(frozen=True)
class Peer:
    """A code that is timed by its own runner: (scene, elements, dt) -> what it found and took."""

    label: str
    run: Callable
    problems: dict[str, str]  # name of a problem by its title
    explicit: bool

    def cases(self, problem: Problem) -> Sequence[Case]:
        """The convergence line; explicit codes with the largest step that is stable."""
        if not problem.compliant:
            return ()
        if problem.static:
            return tuple(Case(n, 1) for n in problem.grids)
        if not self.explicit:
            return tuple(Case(n, steps) for n, steps in problem.ladder)
        end, intervals = problem.times[-1], len(problem.times)
        steps = intervals * int(np.ceil(end / intervals / EXPLICIT_STEP))
        return tuple(Case(n, steps) for n in problem.grids)

    def measure(self, problem: Problem, case: Case, repeats: int) -> Measured | CannotRun:
        """What the peer finds and takes, or why it cannot run this."""
        dt = problem.times[-1] / case.steps
        runs = []
        for _ in range(max(repeats, 1)):
            found = self.run(self.problems[problem.title], case.elements, dt)
            if not hasattr(found, "positions"):
                return CannotRun(found.reason)
            runs.append(found)
        last = runs[-1]
        expected = (len(problem.times), POINTS, 3)
        if last.positions.shape != expected or not np.allclose(last.times, problem.times):
            return CannotRun(
                f"its problem is not this one: positions {last.positions.shape}, not {expected},"
                " or other times"
            )
        return Measured(
            Outcome(Record(last.positions, {}), last.steps, None),
            [run.cpu_seconds for run in runs],
            [run.wall_seconds for run in runs],
            None,
        )


def peer_methods(problems: dict[str, Problem]) -> dict[str, Peer]:
    """The peers as methods, by name."""
    import peers
    from peer_problems import PROBLEMS

    names = {problem.title: name for name, problem in problems.items()}

    def runner(peer):
        def run(name, elements, dt):
            if name not in PROBLEMS:
                return CannotRun("has no such problem in peer_problems.py")
            problem, times = PROBLEMS[name], problems[name].times
            if not problems[name].static:
                problem = dataclasses.replace(problem, times=times)
            return peers.PEERS[peer](problem, elements, dt)

        return run

    return {name: Peer(name, runner(name), names, name in EXPLICIT) for name in peers.PEERS}
