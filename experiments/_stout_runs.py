"""The stout rod's runs by rodjax and by PyElastica, for `stout_against_pyelastica.py`.

PyElastica's law gives each pair of elements nearer than D the force k (D - d) + nu d', whatever
their length: it belongs to a grid. Strands side by side, elements ds long, have two such pairs an
element, 2 k x / ds per length at the depth x = D - d; so on the finer grid k and nu are halved with
ds. rodjax's `Penalty` is a density over both strands and pushes them by (4/3) K x sqrt(2 D x) per
length, on any grid; K and its relaxation time nu / k are taken so that both are equal at the depth
`DEPTH`. The laws differ at other depths (x^3/2 against x), where strands cross at an angle
(pi K D x^2 / sin(angle) against k x), and in the short quadratic beginning that Newton needs.
"""

import sys
import time
from typing import NamedTuple

import example
import jax
import jax.numpy as jnp
import numpy as np
import peer_problems
import peer_pyelastica
from jax import lax

from rodjax import energy, measures, topology
from rodjax.dynamics.adaptive import adaptive_rollout, compile_adaptive_rollout
from rodjax.dynamics.consistency import start
from rodjax.dynamics.run import Run
from rodjax.dynamics.step_control import StepControl
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Penalty
from rodjax.numerics.compilation import compiled
from rodjax.numerics.results import Result
from rodjax.scenes.scene import Scene

PRESET = example.PRESETS["stout"]
RECORD = 0.1  # [s]
SPRING, DASHPOT = 1e4, 10.0  # PyElastica's k [N/m] and nu [N s/m] at 100 elements
DEPTH = 2.5e-4  # where the laws of both codes are equal [m]: about where the strands settle
SOFTNESS = 5e-3  # in diameters
PAIR_MARGIN = 0.01  # [m], of the list of near pairs in the refined run
PAIR_CALLS = 40


class Series(NamedTuple):
    """What is compared, over time; energies in joules."""

    time: np.ndarray
    turns: np.ndarray  # applied
    twist: np.ndarray
    writhe: np.ndarray
    bending: np.ndarray
    torsion: np.ndarray
    stretch: np.ndarray  # of axial stretch and shear
    kinetic: np.ndarray


class Cost(NamedTuple):
    """Of the warm integration loop."""

    cpu_seconds: float
    wall_seconds: float
    steps: int


def problem(until: float) -> peer_problems.Problem:
    """The preset as a problem for every code, recorded every `RECORD`."""
    last = PRESET.drive[-1]
    turns = last[1] + PRESET.rate_after * (example.LAST_TIME - last[0])
    return peer_problems.Problem(
        example.LOADING_AXIS,
        tuple(RECORD * np.arange(1, round(until / RECORD) + 1)),
        diameter=PRESET.diameter,
        neck=(*example.NECK, 0.9),
        seed_curvature=PRESET.seed_curvature,
        turns=(*PRESET.drive, (example.LAST_TIME, turns)),
        slides=True,
        drag=peer_problems.Drag(1000.0, 0.1, 0.01),
    )


def penalty(elements: int) -> Contact:
    """rodjax's contact, equal to PyElastica's between parallel strands at `DEPTH`.

    Its points resolve the law, 1 mm apart at 100 elements: half of sqrt(2 D x) at the depth x.
    Segments half as long as the elements cost least, half of those as long (whose search lists
    twice the pairs of points).
    """
    width = np.sqrt(2 * PRESET.diameter * DEPTH)
    stiffness = 1.5 * SPRING / (example.LENGTH / 100 * width)
    cutoff, aperture, segments = 1.2 * PRESET.diameter, 2 * np.pi / 3, 2 * elements
    reach = cutoff * np.sin(aperture / 2) / (example.LENGTH / segments)
    return Contact(
        Penalty(stiffness, softness=SOFTNESS, relaxation=DASHPOT / SPRING),
        segments=segments,
        points_per_segment=5,
        cutoff=cutoff,
        edge=0.1,
        aperture=aperture,
        pairs_per_segment=max(4, int(np.ceil(reach)) + 1),
    )


def applied_turns(times, until: float) -> np.ndarray:
    """Turns of the drive."""
    knots, turns = np.array(problem(until).turns).T
    return np.interp(times, knots, turns)


@compiled
def _linking(positions, frames):
    """Twist and writhe of framed polygons."""
    one = lambda shape: (topology.twist(*shape), topology.writhe(shape[0]))
    return lax.map(one, (positions, frames))


def pyelastica_run(until: float, elements: int, dt: float, near: bool) -> tuple[Series, Cost]:
    """PyElastica; `near` lists near pairs of elements for the same contact forces sooner."""
    whole, scale = problem(until), 100 / elements
    law = peer_pyelastica.near_self_contact(PAIR_MARGIN, PAIR_CALLS) if near else None
    build = lambda: peer_pyelastica.pyelastica_system(
        whole, elements, (scale * SPRING, scale * DASHPOT), law
    )
    peer_pyelastica.pyelastica_steps(build(), (2 * dt,), dt, lambda *_: None)  # numba compiles
    seen = []

    def look(rod, now):
        moment = 0.5 * np.einsum("iik,ik->ik", rod.bend_matrix, (rod.kappa - rod.rest_kappa) ** 2)
        moment = moment @ rod.rest_voronoi_lengths
        moving = rod.compute_translational_energy() + rod.compute_rotational_energy()
        energies = (moment[0] + moment[1], moment[2], rod.compute_shear_energy(), moving)
        frames = rod.director_collection.transpose(2, 1, 0).copy()  # body to inertial
        seen.append((now, rod.position_collection.T.copy(), frames, energies))
        if len(seen) % 10 == 0:
            print(f"PyElastica, {elements} elements: t = {now:.1f} s", file=sys.stderr, flush=True)

    cost = Cost(*peer_pyelastica.pyelastica_steps(build(), whole.times, dt, look))
    times, positions, frames, energies = (np.array(part) for part in zip(*seen, strict=True))
    return pyelastica_series(until, times, positions, frames, energies), cost


def pyelastica_series(until: float, times, positions, frames, energies) -> Series:
    """The series from nodes (k, n+1, 3), frames (k, n, 3, 3) body to inertial and energies."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(frames.reshape(-1, 3, 3)).as_quat()[:, [3, 0, 1, 2]]
    quaternions = quaternions.reshape(*frames.shape[:2], 4)
    twist, writhe = _linking(jnp.asarray(positions), jnp.asarray(quaternions))
    columns = (times, applied_turns(times, until), twist, writhe)
    return Series(*map(np.asarray, columns), *energies.T)


def rodjax_run(until: float, elements: int, tighter: float) -> tuple[Series, Cost]:
    """rodjax, by adaptive steps with the preset's tolerances divided by `tighter`."""
    scene = peer_problems.rodjax_scene(problem(until), elements, penalty(elements))
    relative, absolute = (tolerance / tighter for tolerance in PRESET.tolerances)
    control = StepControl(relative, absolute, PRESET.max_step)
    compile_adaptive_rollout(scene)
    first = start(scene)
    before = time.process_time(), time.perf_counter()

    def report(part):
        reached = f"t = {part.states.time[-1]:.2f} s" if len(part.states.time) else "no step more"
        said = f"rodjax, {elements} elements: {reached}, {int(part.rejected)} rejected"
        print(said, file=sys.stderr, flush=True)

    run = adaptive_rollout(scene, first, until, control=control, on_chunk=report, throw=False)
    jax.block_until_ready(run.states)
    cost = Cost(
        time.process_time() - before[0],
        time.perf_counter() - before[1],
        len(run.times) - 1 + int(run.rejected),
    )
    if int(run.result) != Result.SUCCESS:
        print(f"rodjax, {elements} elements: failed at t = {float(run.times[-1]):g} s by"
              f" {Result(int(run.result)).name}", file=sys.stderr)  # fmt: skip
    return rodjax_series(scene, run), cost


def rodjax_series(scene: Scene, run: Run) -> Series:
    """The series at the accepted steps of a run."""

    @compiled
    def energies(scene, states):
        parts = (energy.bending_energy, energy.torsion_energy, energy.axial_energy,
                 energy.kinetic_energy)  # fmt: skip
        return lax.map(lambda state: jnp.stack([part(scene, state) for part in parts]), states)

    linking = measures.linking(scene, run)
    found = np.asarray(energies(scene, run.states))
    columns = (run.times, linking.turns, linking.twist, linking.writhe)
    return Series(*map(np.asarray, columns), *found.T)
