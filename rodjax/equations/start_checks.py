"""What a start is refused for, before anything is solved: checks of numbers outside traced code.

A rod that its ends hold twice in some direction has no unique force, a spin that nothing resists
no unique rate, and numbers too small for single precision become zero. Solved all the same, each
gives an answer that depends on rounding, or a failure later on that blames something else.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.equations import joint_terms
from rodjax.equations.imbalance import static_imbalance
from rodjax.inputs.validation import known
from rodjax.interactions.load import total_wrench
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods.balance import constraint_tangent
from rodjax.rods.state import State, at_rest, moved
from rodjax.rods.strains import strains
from rodjax.scenes.holds import rows_at
from rodjax.scenes.scene import Scene, projectors

# How far a driven joint may be off its schedule at a start, in lengths of the rods and radians.
_OFF_ITS_SCHEDULE = 1e-5


def _all_known(*trees) -> bool:
    """Whether no value of the trees is traced."""
    return all(known(leaf) or not hasattr(leaf, "dtype") for leaf in jax.tree.leaves(trees))


@compiled
def least_hold(scene: Scene, state: State) -> Float[Array, ""]:
    """How far the directions that are held are from depending on each other: 0 if they do.

    Inextensibility leaves as motions the displacement of node 0 (over L), the spins of the nodes
    and, where the rod is compliant, stretch and shear of the elements, in the norm of the integral
    of their squares over s / L. On them the rates that ends and supports hold are rows; this is the
    least singular value. Of a rod held at both ends along its chord it is the root mean square
    angle between rod and chord, over sqrt(2): a straight inextensible rod is held twice, since to
    first order the distance of its ends cannot change. The system for the forces has its square
    left.
    """
    rod = scene.rod
    kinematics = strains(rod, state.position, rotations.normalize(state.quaternion))
    shear = constraint_tangent(rod, kinematics).constraint_spin
    total = jnp.sum(rod.length)
    share, weight = rod.length / total, jnp.sqrt(rod.weighing_length / total)[:, None]
    give = 0.0 if rod.compliance is None else (rod.compliance > 0).astype(share.dtype)
    nodes = scene.held_nodes

    def held_motions(first, spins, stretch):
        """Displacements and spins of the held nodes, see `balance`."""
        spins = spins / weight
        both = jnp.concatenate([spins[:-1], spins[1:]], 1)
        edge = jnp.sqrt(share)[:, None] * give * stretch
        edge = edge - share[:, None] * jnp.einsum("nij,nj->ni", shear, both)
        edge = jnp.einsum("nij,nj->ni", kinematics.frame, edge)
        if rod.breaks:  # the next rod moves by itself
            edge = rod.at_breaks(edge, stretch[np.array(rod.breaks)])
        moved = jnp.cumsum(jnp.concatenate([first[None], edge]), 0)
        return rows_at(jnp.concatenate([moved, spins], 1), nodes)

    zero = jnp.zeros_like(state.position)
    parameters = zero[0], zero, zero[1:]
    rows = jax.jacrev(held_motions, (0, 1, 2))(*parameters)
    held = projectors(scene, state.time)
    rows = [jnp.einsum("eij,ej...->ei...", held, part) for part in rows]
    rows = jnp.concatenate([part.reshape(6 * len(nodes), -1) for part in rows], 1)
    free = jax.scipy.linalg.block_diag(*(jnp.eye(6, dtype=held.dtype)[None] - held))
    squares = jnp.linalg.eigvalsh(rows @ rows.T + free)
    return jnp.sqrt(jnp.maximum(squares[0], 0.0))


def _enough_hold(dtype) -> float:
    """The `least_hold` that forces need in this precision."""
    return 30 * float(jnp.finfo(dtype).eps) ** 0.5


def held_twice(scene: Scene, state: State) -> Bool[Array, ""]:
    """Whether the ends hold the rod twice in some direction (see `least_hold`)."""
    least = lax.stop_gradient(least_hold(scene, state))
    return least <= _enough_hold(least.dtype)


def check_held_once(scene: Scene, state: State) -> None:
    """Raise ValueError where the ends hold the rod twice in some direction (see `least_hold`)."""
    if not _all_known(scene, state):
        return
    least = least_hold(scene, state)
    if not known(least) or not float(least) <= _enough_hold(least.dtype):
        return
    if scene.supports:
        raise ValueError(
            f"{scene.holding}: they hold the rod twice in some direction, so its force there is not"
            " determined: between two of them it cannot give way as far as both hold it (an"
            " inextensible stretch that is straight, or nodes side by side). Let one slide along"
            " the rod (Slider), leave more nodes between them, or give the rod axial compliance"
            " (Section(compliance=(0, 0, 1 / EA)) or circular_section(extensible=True))"
        )
    which, chord = _straightest(scene, state)
    along = ", ".join(f"{x:.3g}" for x in chord)
    raise ValueError(
        f"{scene.holding}: they hold {which} twice in some direction, so its force there is not"
        f" determined: inextensible and straight along ({along}), it cannot let its ends come"
        " nearer or part. Let one end slide along the rod (Slider), give the rod axial compliance"
        " (Section(compliance=(0, 0, 1 / EA)) or circular_section(extensible=True)), or place it"
        f" curved, at angles to ({along}) of more than"
        # see `least_hold`
        f" {2**0.5 * _enough_hold(least.dtype):.2g} rad (root mean square) in {least.dtype.name}"
    )


def _straightest(scene: Scene, state: State) -> tuple[str, Float[np.ndarray, "3"]]:
    """Which of the rods of the scene is so nearest to it, and its direction."""
    position, parts = np.asarray(state.position, float), scene.rod.parts
    lengths = np.asarray(scene.rod.length, float)
    chords = [position[part.last] - position[part.first] for part in parts]
    sizes = [np.linalg.norm(chord) for chord in chords]
    spare = [np.sum(lengths[part.elements]) - x for part, x in zip(parts, sizes, strict=True)]
    i = int(np.argmin(np.asarray(spare) / [np.sum(lengths[part.elements]) for part in parts]))
    name = f"rods[{i}]" if scene.rod.breaks else "the rod"
    return name, chords[i] / sizes[i]


def check_driven_joints(scene: Scene, state: State) -> None:
    """Raise ValueError where a joint's schedule has its points elsewhere than the state has."""
    for i, joint in enumerate(scene.joints):
        along = joint.driven()
        if along is None or not _all_known(joint, state, scene.rod):
            continue
        motion = at_rest(state.time, state.position, state.quaternion)
        gap = np.asarray(joint_terms.gaps(scene, motion)[i], float)
        off = np.abs(gap / np.repeat([float(jnp.sum(scene.rod.length)), 1.0], 3))
        if np.max(off) > _OFF_ITS_SCHEDULE:
            (name, schedule), time = *joint.schedules.items(), float(state.time)
            raise ValueError(
                f"joints[{i}].{name}: its schedule says {float(schedule(state.time)):.3g} at"
                f" t = {time:.3g}, where the state has another; give a schedule that is 0 where"
                " the rods are as they are placed"
            )


def check_spin(scene: Scene, state: State) -> None:
    """Raise ValueError where nothing resists the rod's spin about its own axis.

    Without rotary inertia about it the spin of all sections alike is held by an end that takes
    away their rotation about the tangent, by a drag or another load on it, or by bending where
    the rod has a natural curvature or unequal stiffnesses.
    """
    rod = scene.rod
    if rod.mass is None or not _all_known(scene, state):
        return
    if rod.rotary_inertia is not None and np.any(np.asarray(rod.rotary_inertia[:, 2]) > 0):
        return
    if any(lump.inertia is not None for lump in rod.lumps):
        return
    both = projectors(scene, state.time)
    if not known(both) or np.any(np.asarray(both)[:, 5, 5] > 1e-6):
        return
    stiffness, drag = _spin_resistance(scene, state)
    if abs(float(stiffness)) > 1e-9 or float(drag) > 0:
        return
    raise ValueError(
        "rotary_inertia: the rod can spin about its own axis, and has neither inertia against it"
        " (rotary_inertia=None) nor an end or a load that holds it. Give the section rotary inertia"
        " (circular_section(rotary_inertia=True)), hold the spin at one end (Clamped, Slider, or a"
        " hinge whose projector takes away the rotation about the tangent), or add a LinearDrag"
        " with rotational > 0"
    )


@compiled
def _spin_resistance(scene: Scene, state: State):
    """Work of the moments on a unit spin of all sections about their tangents, over A / L; drag."""
    rod = scene.rod
    spin = jnp.zeros_like(state.rate).at[:, 5].set(1.0)
    motion = at_rest(state.time, state.position, state.quaternion)
    wrench = lambda z: static_imbalance(scene, moved(motion, z), state.force)[0]
    change = jax.jvp(wrench, (jnp.zeros_like(spin),), (spin,))[1]
    unit = jnp.mean(rod.solid(rod.stiffness)) / jnp.sum(rod.length)
    drag = jnp.zeros(())
    if scene.loads:
        rate = lambda z: -total_wrench(scene.loads, rod, motion._replace(angular_velocity=z[:, 3:]))
        drag = jnp.sum(spin * jax.jvp(rate, (jnp.zeros_like(spin),), (spin,))[1])
    return jnp.sum(spin * change) / unit, drag


def check_single_precision(scene: Scene, *, moving: bool = True) -> None:
    """Raise ValueError where a rod's numbers are too small for its precision.

    The smallest are the rotary inertia of an element and, in the equations of motion (`moving`),
    the moment unit of an element, m ds^3: in SI those of a molecule vanish in float32.
    """
    rod = scene.rod
    if rod.mass is None or not _all_known(rod):
        return
    length = np.asarray(rod.solid(rod.length), float)
    numbers = {}
    if rod.rotary_inertia is not None:
        inertia = np.asarray(rod.solid(rod.rotary_inertia), float) * length[:, None]
        numbers["rotary_inertia: of an element"] = inertia[inertia > 0]
    if moving:
        numbers["mass: with the length of an element, m ds^3"] = (
            np.asarray(rod.solid(rod.mass)) * length**3
        )
    kind = rod.position.dtype
    for name, values in numbers.items():
        least = np.min(values, initial=np.inf)
        # sums and halves of it must not be lost either
        if least < 1e3 * float(jnp.finfo(kind).tiny):
            raise ValueError(
                f"{name} it is {least:.2g}, too small for {kind.name}: in single precision it"
                " becomes zero. Take units near the rod's own size (nm, pN, and so on, see Units),"
                " or double precision (jax.config.update('jax_enable_x64', True))"
            )


def check_size(name: str, array) -> None:
    """Raise ValueError where squares of squares of the values overflow (outside traced code)."""
    if not known(array):
        return
    largest, limit = float(np.max(np.abs(array))), float(jnp.finfo(array.dtype).max) ** 0.25
    if largest > limit:
        raise ValueError(f"{name}: must be smaller than {limit:.0e}, got {largest:.3g}")
    if name == "quaternion" and not np.all(np.linalg.norm(array, axis=1) > 1e-3):
        raise ValueError("quaternion: must have unit length at every node, got one of no length")
