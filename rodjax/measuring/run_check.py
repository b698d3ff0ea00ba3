"""What a finished run could not resolve, in words.

A run that solved its equations may still have too coarse a grid, contact or time step, or end in a
state in which no rod would stay. `check` looks at all of that; the runs themselves look at what
costs nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rodjax.dynamics.coarseness import BEND, TWIST, largest_turns
from rodjax.dynamics.run import Run
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.equilibria.linear_stability import stability
from rodjax.equilibria.unstable_modes import neutral
from rodjax.interactions import sites
from rodjax.interactions.contact_law import PairProperties, continued
from rodjax.measuring import energy, measures, numerical_damping
from rodjax.numerics.results import MESSAGES, Result
from rodjax.scenes import drives
from rodjax.scenes.corners import corners_inside
from rodjax.scenes.scene import Scene

STEPS = 0.2  # local errors over motion, rms
DAMPED = 0.05  # part of the energy that the time integration takes
RESIDUAL = 0.05  # of the ledger, over the energy that was moved
PUSH = 0.01  # contact over the rod's own forces, below which how finely it is summed matters little
TAIL = 0.01  # a law at its cut-off over the law where strands came nearest
AT_REST = 1e-3  # kinetic over strain energy below which a state is one of rest
DENSE = 300  # elements up to which stability is looked at


class Finding(NamedTuple):
    """One thing that a run did not resolve."""

    topic: str
    value: float
    limit: float
    meaning: str  # and the mend

    def __str__(self) -> str:
        return f"{self.topic}: {self.value:.3g} (at most {self.limit:.3g}). {self.meaning}"


class Findings(NamedTuple):
    """What `check` found; true if anything. Printed, one finding a paragraph."""

    found: tuple[Finding, ...]
    looked_at: tuple[str, ...]  # the topics that applied

    def __bool__(self) -> bool:
        return bool(self.found)

    def __str__(self) -> str:
        topics = ", ".join(self.looked_at)
        if not self.found:
            return f"resolved, as far as can be told ({topics})"
        return "\n".join(map(str, self.found)) + f"\n(looked at: {topics})"


def check(scene: Scene, run: Run, method: GeneralizedAlpha | None = None) -> Findings:
    """Look at a finished run for what it could not resolve (not in traced code).

    Args:
        scene: of the run, which does not keep it.
        method: with which it was made, for its spectral radius and tolerance.

    Looked at, as far as the scene has it: the result's code; turns of elements; ends against their
    schedules, and corners of schedules inside steps; local errors of the steps; numerical damping
    of the motion's mean frequency; the energy ledger; the spacing of contact points where contact
    pushes most and, of a law that only fades, its tail beyond the cut-off; and whether the state at
    the end, where it is one of rest, is stable. It compiles the measures that it needs.

    Example:
        >>> findings = rx.check(scene, run)
        >>> print(findings)  # doctest: +SKIP
    """
    method = GeneralizedAlpha() if method is None else method
    good = bool(np.all(np.isfinite(np.asarray(run.states.position))))
    topics: dict[str, Finding | None] = {"result": _result(run)}
    if good:
        topics |= _grid(run)
        topics |= _schedules(scene, run, method)
    if good and len(run.times) > 1 and scene.rod.mass is not None:
        topics |= _time(scene, run, method)
    if good:
        topics |= _contact(scene, run)
        topics |= _stable(scene, run)
    return Findings(tuple(f for f in topics.values() if f is not None), tuple(topics))


def _grid(run: Run) -> dict[str, Finding | None]:
    bend, twist = largest_turns(np.asarray(run.states.quaternion), run.states.breaks)
    return {
        "bend of an element [rad]": _above(
            "bend of an element [rad]", bend, BEND,
            f"The grid is too coarse for the curvature; use {bend / BEND:.2g} times the elements.",
        ),
        "twist of an element [rad]": _above(
            "twist of an element [rad]", twist, TWIST,
            f"Where the rod bends as well, use {twist / TWIST:.2g} times the elements.",
        ),
    }  # fmt: skip


def _above(topic: str, value: float, limit: float, meaning: str) -> Finding | None:
    return None if value <= limit else Finding(topic, value, limit, meaning)


def _result(run: Run) -> Finding | None:
    code = Result(int(run.result))
    return _above("result", float(code), 0.0, f"{code.name}: {MESSAGES[code]}.")


def _schedules(scene: Scene, run: Run, method) -> dict[str, Finding | None]:
    steps = run.infos.iterations.shape[0]
    topics: dict[str, Finding | None] = {}
    driven = any(h.end.displacement is not None or h.end.rotation is not None for h in scene.holds)
    if driven and len(run.times) > 1:
        allowed = method.newton_error(run.states.position.dtype, steps)
        off = drives.astray(scene, run.states, allowed)
        topics["ends"] = _above("ends", float(off), 0.0, MESSAGES[Result.DRIVE_MISSED] + ".")
    if steps == len(run.times) - 1 and steps > 0:
        times = np.asarray(run.times)
        inside = corners_inside(scene, float(times[0]), times[1:])
        topics["corners"] = _above(
            "corners", float(len(inside)), 0.0,
            f"Loads or drives' velocities jump inside steps ({', '.join(inside)}), which makes the"
            " motion first order; end steps there: np.union1d(times, scene.corners).",
        )  # fmt: skip
    return topics


def _time(scene: Scene, run: Run, method) -> dict[str, Finding | None]:
    infos = jax.tree.map(np.asarray, run.infos)
    squares = lambda v: float(np.sum(np.where(infos.settling, 0.0, v) ** 2))
    motion = squares(infos.growth_position)
    length = float(np.sum(np.asarray(scene.rod.length)))
    ratio = 0.0
    if motion > (1e-4 * length) ** 2:
        ratio = float(np.sqrt(squares(infos.error_position) / motion))
    ledger = energy.ledger(scene, run)
    strain, kinetic, residual = map(np.asarray, (ledger.strain, ledger.kinetic, ledger.residual))
    part = float(np.max(np.abs(residual)) / _moved(scene, ledger))
    topics = {
        "local errors of the steps": _above(
            "local errors of the steps", ratio, STEPS,
            "The steps do not resolve the motion; use smaller ones, or the adaptive rollout.",
        ),
        "energy ledger": _above(
            "energy ledger", part, RESIDUAL,
            "So much of the energy moved is not accounted for: lost in the steps (use smaller"
            " ones), in a velocity of a drive that jumps (use Smooth), or saved too rarely for the"
            " ledger.",
        ),
    }  # fmt: skip
    # a slow process, whose waves do not matter, has no kinetic energy to speak of
    if np.max(kinetic) > 0.01 * np.ptp(strain) > 0:
        lost, steps = numerical_damping.estimate(scene, run, float(method.spectral_radius))
        topics["numerical damping"] = _above(
            "numerical damping", lost, DAMPED,
            f"With {steps:.3g} steps in the motion's mean period the time integration takes so much"
            " of the energy of its vibration; use more steps, or a spectral radius nearer 1.",
        )  # fmt: skip
    return topics


def _moved(scene: Scene, ledger: energy.Ledger) -> float:
    """The most energy that any part of a ledger gave, took or lost [J]; above rounding."""
    stored = [ledger.strain, ledger.kinetic, ledger.gravity, ledger.contact_energy]
    passed = [ledger.work, ledger.drag_loss, ledger.damping_loss, ledger.projection_loss]
    passed += [ledger.contact_work]
    elastic = np.asarray(scene.rod.mean_bending)
    elastic = elastic / np.sum(np.asarray(scene.rod.length))
    return max(
        float(np.sqrt(np.finfo(elastic.dtype).eps) * elastic),
        float(np.max(np.asarray(ledger.kinetic))),
        *(float(np.ptp(np.asarray(v))) for v in stored if v is not None),
        *(float(np.max(np.abs(np.asarray(v)))) for v in passed),
    )


def _contact(scene: Scene, run: Run) -> dict[str, Finding | None]:
    the_contact = scene.contact
    if the_contact is None:
        return {}
    found = measures.contacts(scene, run)
    most = int(np.argmax(np.asarray(found.total)))
    push, ratio = (float(np.asarray(v)[most]) for v in (found.total, found.smallest))
    if push == 0 or not np.isfinite(ratio):
        return {}
    where = sites.sites_of(the_contact, scene.rod, scene.closed)
    diameter = np.max(np.asarray(where.diameter))
    mass = None if where.mass is None else jnp.mean(where.mass)
    pair = PairProperties(jnp.asarray(diameter), mass)
    law = lambda d: continued(the_contact.law, d, jnp.zeros_like(d), pair)
    distance = jnp.asarray(ratio * diameter)
    force, slope = jax.jvp(law, (distance,), (jnp.ones_like(distance),))
    force, slope = abs(float(force)), abs(float(slope))
    settled = float(distance)
    width = force / slope if slope > 0 else np.inf
    allowed = min(settled / 3, np.sqrt(2 * settled * width) / 2)
    spacing = float(np.max(np.asarray(where.spacing)))
    inner = float(np.max(np.linalg.norm(np.asarray(run.states.force), axis=-1)))
    bending = float(scene.rod.mean_bending)
    inner = max(inner, bending / float(np.sum(np.asarray(scene.rod.length))) ** 2)
    topics = {}
    if push > PUSH * inner:
        topics["spacing of contact points"] = _above(
            "spacing of contact points", spacing, allowed,
            "The points are too far apart for the law where contact pushes most, so its force"
            f" ripples; use {spacing / allowed:.2g} times the `segments` or `points_per_segment`.",
        )  # fmt: skip
    if the_contact.law.extent(pair) is not None:  # which the cut-off does not touch
        return topics
    # before the window that fades the force out
    edge = the_contact.cutoff * (1 - the_contact.edge)
    tail = abs(float(law(jnp.asarray(edge)))) / force if force > 0 else 0.0
    if float(edge) <= settled:
        tail = 1.0
    topics["tail of the contact law"] = _above(
        "tail of the contact law", tail, TAIL,
        "Where the cut-off begins to fade it out, the law still has so much of the force at the"
        " nearest strands; raise `cutoff`.",
    )  # fmt: skip
    return topics


def _stable(scene: Scene, run: Run) -> dict[str, Finding | None]:
    final = run.final
    if scene.rod.elements > DENSE:
        return {}
    strain = float(energy.bending_energy(scene, final) + energy.torsion_energy(scene, final))
    moving = 0.0 if scene.rod.mass is None else float(energy.kinetic_energy(scene, final))
    if moving > AT_REST * strain:
        return {}
    try:
        lowest = float(stability(scene, final).eigenvalues[0])
    except ValueError:  # the ends leave it free to move: not a state that could be unstable
        return {}
    return {
        "lowest eigenvalue at the end [N]": _above(
            "lowest eigenvalue at the end [N]", -lowest, float(neutral(scene, final.force)),
            "The rod is at rest in a state that is unstable (the lowest eigenvalue is minus that):"
            " nothing has excited its modes. Give it an imperfection that does, a small load or a"
            " natural curvature that is not uniform.",
        )
    }  # fmt: skip
