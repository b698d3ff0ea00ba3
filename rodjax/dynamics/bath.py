"""A heat bath: its thermal energy, how its steps are solved, and what a rod in it must have."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.equations.node_drag import excess_drag, node_drag, shared_drag
from rodjax.inputs.validation import (
    all_known,
    as_float,
    check_flag,
    check_integer,
    check_not_negative,
    check_positive,
    check_scalar,
)
from rodjax.interactions.contact_energy import has_potential
from rodjax.interactions.contact_law import PairProperties, ignores_approach
from rodjax.numerics.compilation import compiled
from rodjax.rods.state import NodeMotion, at_rest
from rodjax.scenes.scene import Scene

_DRAG = (
    "add LinearDrag(normal, tangential, rotational) with all three positive (for a body or a bead"
    " PointDrag(linear=..., rotational=...)) to the scene's loads"
)


class Bath(eqx.Module):
    """A heat bath around a rod that moves without inertia.

    The drag is that of the scene's loads; by fluctuation and dissipation it and kT say what the
    noise is. kT = 0 leaves overdamped motion without noise.

    Args:
        thermal_energy: kT [J]; 4.114 pN nm at 25 degrees Celsius.
        implicit: whether steps are those of the midpoint rule (`equations.overdamped`), which solve
            the rod's equations and may be longer than its fastest modes; else they are explicit
            (`dynamics.explicit_thermal`), of which thirty cost as much and which must follow the
            fastest mode (`relaxation_times`).
        tolerance: (implicit) predicted error of Newton's method, in rotations [rad] and
            displacements over the mean element length. Noise hides far more than the default.
        max_iterations: (implicit) Newton iterations allowed in a step.

    Example:
        >>> water = rx.Bath(thermal_energy=4.114)  # in nm and pN
    """

    thermal_energy: Float[Array, ""] = eqx.field(converter=as_float)
    implicit: bool = eqx.field(static=True, default=False)
    tolerance: Float[Array, ""] = eqx.field(converter=as_float, default=1e-6)
    max_iterations: Int[Array, ""] = eqx.field(
        converter=lambda count: jnp.asarray(count, jnp.int32) if type(count) is int else count,
        default=20,
    )

    def __check_init__(self):
        numbers = {"thermal_energy": self.thermal_energy, "tolerance": self.tolerance}
        check_scalar(**numbers)
        check_flag(implicit=self.implicit)
        check_not_negative(thermal_energy=self.thermal_energy)
        check_positive(tolerance=self.tolerance)
        if all_known(self.max_iterations):
            whole = jnp.issubdtype(getattr(self.max_iterations, "dtype", float), jnp.integer)
            count = int(self.max_iterations) if whole else self.max_iterations
            check_integer(1, 10_000, max_iterations=count)


def check_thermal(scene: Scene) -> None:
    """Raise ValueError where a rod in a bath would not have the statistics of equilibrium.

    That is: without drag, with drag that is not linear, with what loses energy otherwise (there is
    no noise of it), or with constraints whose metric would bias it. Nothing of it in traced code.
    """
    _check_losses(scene)
    _check_compliance(scene)
    _check_joints(scene)
    if not scene.loads:
        raise ValueError(f"loads: a rod in a heat bath needs drag, and has no load; {_DRAG}")
    if all_known(scene):
        _check_drag(scene)


def _check_losses(scene: Scene) -> None:
    material = scene.rod.material
    if material is not None and (material.viscous or material.remembers):
        raise ValueError(
            "material: loses energy inside the rod, and the bath has no noise of that; take one"
            " that is elastic, and let the drag of the loads be all that resists"
        )
    if any(load.remembers for load in scene.loads):
        raise ValueError(
            "loads: one of them remembers the motion (an anchor of friction): it loses energy, and"
            " the bath has no noise of that; leave the friction out"
        )
    if any(load.rubs for load in scene.loads):
        raise ValueError(
            "loads: one of them has friction that slides: it loses energy, and the bath has no"
            " noise of that; leave the friction out"
        )
    contact = scene.contact
    if contact is None:
        return
    one = jnp.ones((), scene.rod.position.dtype)
    mass = None if scene.rod.mass is None else one
    if contact.friction is not None or not ignores_approach(contact.law, PairProperties(one, mass)):
        raise ValueError(
            "contact: its friction or damping loses energy, and the bath has no noise of that; take"
            " a law of the distance alone, such as DebyeHueckel or Contact.solid(rod, force)"
        )
    potential = has_potential(contact)
    if all_known(potential) and not bool(potential):
        raise ValueError(
            "contact: with an aperture its forces have no potential, and a bath no equilibrium;"
            " give aperture=numpy.pi"
        )


def _check_compliance(scene: Scene) -> None:
    mend = (
        "compliance: a rod in a heat bath must stretch and shear at least a little, for a rigid"
        " constraint biases its distribution (the metric's determinant); give all three components"
        " of the section's compliance, or take yielding(rod)"
    )
    given = scene.rod.compliance
    if given is None:
        raise ValueError(mend)
    if all_known(given) and not np.all(np.asarray(scene.rod.solid(given)) > 0):
        raise ValueError(mend)


def _check_joints(scene: Scene) -> None:
    for index, joint in enumerate(scene.joints):
        offsets = [joint.first.offset, joint.second.offset]
        apart = all_known(*offsets) and any(np.any(np.asarray(one) != 0) for one in offsets)
        if not joint.rejoins or joint.schedules or apart:
            raise ValueError(
                f"joints[{index}]: rods in a heat bath are joined by Weld between nodes without"
                " offsets (a ring, a body on a node); other joints would bias the distribution and"
                " drift. For a bead that stands off its node give the node PointDrag(node, ...)"
            )


def _check_drag(scene: Scene) -> None:
    with jax.ensure_compile_time_eval():
        rod = scene.rod
        motion = at_rest(jnp.zeros((), rod.position.dtype), rod.position, rod.quaternion)
        rows = np.random.default_rng(0).normal(size=(scene.rod.elements + 1, 6))
        rate = rows * np.repeat([float(scene.rod.mean_length), 1.0], 3)
        rate = jnp.asarray(rate, motion.position.dtype)
        found = _probed(scene, motion, rate)
        drag, excess, elsewhere = (np.asarray(one, float) for one in found[:3])
    if found[3] is not None and np.any(np.asarray(found[3]) != 0):
        raise ValueError(
            "loads: the drag of a node in a heat bath must be on its own motion, for noise to"
            " belong to it; a load that acts between nodes must not resist velocities"
        )
    least = np.linalg.eigvalsh(0.5 * (drag + np.swapaxes(drag, 1, 2)))[:, 0]
    bad = ~(least > 0)
    if np.any(bad):
        node = int(np.argmax(bad))
        raise ValueError(
            f"loads: a rod in a heat bath needs drag in all directions, and node {node} has none in"
            f" some; {_DRAG}"
        )
    if not np.allclose(drag, np.swapaxes(drag, 1, 2), rtol=1e-6, atol=1e-9 * np.max(np.abs(drag))):
        raise ValueError(
            "loads: the drag of a node must be symmetric (Onsager), for noise to belong to it"
        )
    largest = np.max(np.abs(drag))
    coupled = np.max(np.abs(drag[:, :3, 3:]), (1, 2)) > 1e-12 * largest
    if np.any(coupled):
        raise ValueError(
            f"loads: the drag of node {int(np.argmax(coupled))} couples its displacement with its"
            " turning, and noise of that asks for a drift that is not there; give PointDrag without"
            " an offset (a bead's drag at the node that it is fixed to)"
        )
    if np.max(np.abs(elsewhere - drag)) > 1e-6 * largest:
        raise ValueError(
            "loads: the drag of a node must not depend on where it is, for noise of that asks for a"
            " drift that is not there (no damping in an obstacle: Obstacle(..., relaxation=0); no"
            " fluid that is thicker at some places)"
        )
    linear = np.abs(np.einsum("nij,nj->ni", drag, np.asarray(rate)))
    beyond = np.max(np.abs(excess), 0) / np.maximum(np.max(linear, 0), 1e-300)
    if np.max(beyond) > 1e-6:
        raise ValueError(
            "loads: the drag of a rod in a heat bath must be linear in the velocities, for noise to"
            " belong to it (no MorisonDrag, no PointDrag(quadratic=...), no friction): take"
            " LinearDrag"
        )


@compiled
def _probed(scene: Scene, motion: NodeMotion, rate: Float[Array, "nodes 6"]):
    """The drag of the nodes, what is not linear at rates of an element length and a radian in a
    unit of time, and the drag after the whole moved by the rods' length one way or another.
    """
    reach = jnp.sum(scene.rod.length)
    ways = jnp.concatenate([jnp.eye(3), -jnp.eye(3)]).astype(reach.dtype)
    at = lambda way: node_drag(scene, motion._replace(position=motion.position + reach * way[None]))
    shared = shared_drag(scene, motion) if scene.between_nodes else None
    drag, excess = node_drag(scene, motion), excess_drag(scene, motion, rate)
    return drag, excess, jax.lax.map(at, ways), shared
