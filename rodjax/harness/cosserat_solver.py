"""This library as a solver of cosseratbench, a public benchmark of rods.

That package finds the class by its entry points. It is imported when a solver is made, so nothing
else of the library needs it.
"""

import math
import warnings
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from rodjax.dynamics.adaptive import adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.fixed_rollout import rollout
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.files.versions import version
from rodjax.harness.material_lines import material_lines
from rodjax.harness.refinement import refined
from rodjax.harness.translation import scene_of, settings_of, touching
from rodjax.numerics.results import MESSAGES, ModelWarning, Result
from rodjax.scenes.scene import Scene

if TYPE_CHECKING:
    from cosseratbench.solver import Capability
    from cosseratbench.trajectory import Trajectory

# Steps in the slowest period: what passes through equilibria, and motion that is itself wanted.
_STEPS_AT_REST, _STEPS_IN_MOTION = 20, 1600

# Newton's tolerance where steps are chosen by their error, far below that.
_TOLERANCE = 1e-7

# Spectral radii at infinite step, of the same.
_AT_REST, _IN_MOTION = 0.0, 0.9

Frames = tuple[Float[np.ndarray, "t nodes 3"], Float[np.ndarray, "t nodes 4"]]


class CosseratSolver:
    """What `cosseratbench run --solver rodjax` runs.

    Rods are extensible and shearable, in double precision whatever the process is set to. Steps
    are implicit: fixed ones without contact, chosen by the local error with it. Motion that is
    itself the result is run twice, with the elements asked for and with four for every five and
    longer steps, and extrapolated from both (`extrapolate`), where nothing touches.

    Args:
        time_step_scale: multiplies the steps, and with them the tolerances of chosen ones.
    """

    name = "rodjax"
    backend_version = version()

    def __init__(self, time_step_scale: float = 1.0) -> None:
        import cosseratbench.solver  # noqa: F401 (where it is missing the benchmark says so)

        self.time_step_scale = float(time_step_scale)

    @property
    def capabilities(self) -> "frozenset[Capability]":
        """All that the benchmark asks for; friction of rods on each other is smoothed by speed."""
        from cosseratbench.solver import Capability

        return frozenset(
            {
                Capability.STRETCH,
                Capability.SHEAR,
                Capability.ROD_CONTACT,
                Capability.ROD_FRICTION,
                Capability.CYLINDER_CONTACT,
                Capability.PLANE_CONTACT,
            }
        )

    def settings(self, scenario: Any, *, n_elements: int, n_frames: int) -> dict[str, Any]:
        """The numbers chosen for a scenario."""
        chosen, by_error = settings_of(scenario), touching(scenario)
        steps = self._steps_per_frame(scenario, n_elements, n_frames)
        interval = scenario.duration / (n_frames - 1)
        found = {
            "integrator": "generalised-alpha on R^3 x SO(3) (implicit)",
            "spectral_radius": _radius(scenario),
            "steps": "by the local error" if by_error else "fixed",
            "largest_time_step" if by_error else "time_step": interval / steps,
            "damping_rate": chosen.damping_rate,
            "inertia_kept": chosen.inertia,
        }
        if by_error:
            found["sinks_in_radii"] = chosen.sink
        if (fewer := _coarser(scenario, n_elements)) is not None:
            found["extrapolated_from_elements"] = [fewer, n_elements]
        return found

    def run(self, scenario: Any, *, n_elements: int, n_frames: int) -> "Trajectory":
        """The motion of a scenario at evenly spaced times.

        Raises:
            NotImplementedError: the scenario asks for what the library has not.
            cosseratbench.solver.Diverged: a step failed.
        """
        from cosseratbench.trajectory import Trajectory

        steps = self._steps_per_frame(scenario, n_elements, n_frames)
        with jax.enable_x64(True):
            found = self._frames(scenario, n_elements, n_frames, steps)
            if (fewer := _coarser(scenario, n_elements)) is not None:
                coarse = self._frames(scenario, fewer, n_frames, steps * fewer // n_elements)
                found = [(refined(a[0], b[0]), b[1]) for a, b in zip(coarse, found, strict=True)]
        lines = (
            material_lines(*one, rod.directors(n_elements))
            for one, rod in zip(found, scenario.rods, strict=True)
        )
        times = np.linspace(0.0, scenario.duration, n_frames)
        return Trajectory(times, tuple(position for position, _ in found), tuple(lines))

    def _steps_per_frame(self, scenario: Any, elements: int, frames: int) -> int:
        """How many steps a frame takes, where they are chosen at least."""
        wanted = _STEPS_AT_REST if scenario.quasi_static else _STEPS_IN_MOTION
        period = 2 * math.pi / settings_of(scenario).slowest
        longest = self.time_step_scale * period / wanted
        steps = max(math.ceil(scenario.duration / (frames - 1) / longest * (1 - 1e-9)), 1)
        # on the coarser grid there are as many times fewer
        return steps if _coarser(scenario, elements) is None else 5 * math.ceil(steps / 5)

    def _frames(self, scenario: Any, elements: int, frames: int, steps: int) -> list[Frames]:
        """Positions and frames of the nodes of every rod at the times asked for."""
        scene = scene_of(scenario, elements, settings_of(scenario))
        run = self._run(scenario, scene, frames, steps)
        wanted = np.linspace(0.0, scenario.duration, frames)
        at = np.searchsorted(np.asarray(run.times), wanted - 1e-9 * scenario.duration)
        position, quaternion = np.asarray(run.states.position), np.asarray(run.states.quaternion)
        return [
            (position[at, part.nodes], quaternion[at, part.nodes]) for part in scene.rod.strands
        ]

    def _run(self, scenario: Any, scene: Scene, frames: int, steps: int) -> Run:
        """The run, every frame among its states."""
        from cosseratbench.solver import Diverged

        until, tolerance = scenario.duration, _TOLERANCE if touching(scenario) else None
        method = GeneralizedAlpha(_radius(scenario), tolerance)
        times = np.linspace(0.0, until, (frames - 1) * steps + 1)[1:]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ModelWarning)  # the benchmark looks at the motion
            state = start(scene)
            if touching(scenario):
                finer = self.time_step_scale**2
                control = StepControl(0.01 * finer, 2.5e-3 * finer, max_step=until / len(times))
                run = adaptive_rollout(
                    scene, state, until, method, control, stops=times, throw=False
                )
            else:
                run = rollout(scene, state, times, method, save_every=steps, throw=False)
        result = Result(int(run.result))
        # where equilibria count vibrations may remain unresolved
        if result not in (Result.SUCCESS, Result.UNRESOLVED):
            good = np.isfinite(np.asarray(run.states.position)).all(axis=(1, 2))
            raise Diverged(MESSAGES[result], time=float(np.asarray(run.times)[good][-1]))
        return run


def _coarser(scenario: Any, elements: int) -> int | None:
    """Elements of the grid to extrapolate from, where the motion counts and is smooth."""
    smooth = not (scenario.quasi_static or touching(scenario))
    return 4 * elements // 5 if smooth and elements % 5 == 0 and elements >= 10 else None


def _radius(scenario: Any) -> float:
    return _AT_REST if scenario.quasi_static else _IN_MOTION
