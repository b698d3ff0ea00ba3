"""A state brought onto another grid of the same rod.

Frames are interpolated along the arc length by cubics in the rotation vectors of the elements, and
the nodes put along them: an inextensible rod stays unstretched on its new grid, to rounding.
"""

import jax
import jax.numpy as jnp
from jax import lax

from rodjax.inputs.validation import check_instance, known
from rodjax.numerics import rotations
from rodjax.numerics.compilation import compiled
from rodjax.rods.chain import alone, check_alone
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.rods.strains import element_quaternions, relative_rotation

_CORRECTIONS = 4


def regrid(state: State, rod: Rod, *, old: Rod | None = None) -> State:
    """The state on the grid of `rod`, with any number of elements.

    Args:
        state: of the same rod on another grid.
        rod: the rod on the new grid; its placing plays no part.
        old: the rod that the state is of. Without it the lengths of the old elements are taken to
            be the distances of their nodes, right for a rod without compliance.

    Both ends keep their places and frames (of a straight rod the far end to second order in the
    spacing). Between them positions and frames are off by the square of the coarser spacing, as
    the grids themselves are. Velocities are interpolated, and so are accelerations and forces,
    which `start` finds exactly, with velocities that agree with the constraints:

        new = regrid(state, rod)
        state = start(scene, position=new.position, quaternion=new.quaternion,
                      velocity=new.velocity, angular_velocity=new.angular_velocity, time=new.time)

    Differentiable in the state.

    Raises:
        ValueError: the rods are not of one length; the state is not one, or not of `old`; an
            element of the new grid would turn by more than 0.9 of a revolution, or the line
            would move by more than half an element (checked outside traced code).

    Example:
        >>> fine = rx.straight_rod(1.0, 40, section)
        >>> rx.regrid(run.final, fine).position.shape
        (41, 3)
    """
    check_instance(State, "give a state, such as `run.final`", state=state)
    check_instance(Rod, "give the rod on its new grid", rod=rod)
    if state.position.ndim != 2:
        raise ValueError("state: give one state, such as `run.final` or `run.state(3)`")
    alone(state, "another grid")
    check_alone(rod, "another grid")
    if state.memory is not None and state.memory.material is not None:
        raise ValueError(
            "state.memory: what a material remembers is not carried over to another grid; go on on"
            " its own, or drop it by dataclasses.replace(state, memory=None)"
        )
    if rod.torque_per_tension is not None:
        raise ValueError(
            "torque_per_tension: the stretch of such a cable follows its twist, which is not"
            " carried over; start it anew on the other grid"
        )
    if old is not None:
        check_instance(Rod, "give the rod that the state is of", old=old)
        if old.elements + 1 != state.position.shape[0]:
            raise ValueError(
                f"old: has {old.elements} elements, but the state {state.position.shape[0] - 1}"
            )
    new, ratio, turned, off = _regridded(state, rod, old)
    if known(ratio) and not abs(float(ratio) - 1) < 1e-3:
        total = float(jnp.sum(rod.length))
        raise ValueError(
            f"rod: has length {total:g}, but the state's is {total / float(ratio):g}; a state can"
            " be brought onto another grid of the same rod only (of one with compliance give `old`)"
        )
    if known(turned) and float(turned) > 0.9:
        raise ValueError(
            f"rod: an element of the new grid would turn by {float(turned):.2g} revolutions; use"
            " more elements"
        )
    if known(off) and not float(off) < 0.5:
        raise ValueError(
            f"state: its line would move by {float(off):.2g} elements; one of the grids is too"
            " coarse for the shape: use more elements"
        )
    return new


@compiled
def _regridded(state, rod, old):
    """The state, the ratio of the lengths, the turns of an element, how far the line moves."""
    edges = state.position[1:] - state.position[:-1]
    length = jnp.linalg.norm(edges, axis=1) if old is None else old.length
    ratio = jnp.sum(rod.length) / jnp.sum(length)
    length = length * ratio
    before = jnp.concatenate([jnp.zeros_like(length[:1]), jnp.cumsum(length)])
    after = jnp.minimum(rod.arc_length, before[-1])
    turn = rotations.logarithm(relative_rotation(state.quaternion))
    quaternion = _frames(state.quaternion, turn, before, after)
    stretch = _stretch(state, rod, length)
    quaternion = _closed(quaternion, stretch, rod, state.position[-1] - state.position[0])
    along = lambda values: _cubic(before, values, after)
    middle = lambda nodes: 0.5 * (nodes[1:] + nodes[:-1])
    new = State(
        state.time,
        state.position[:1] + _line(quaternion, stretch, rod),
        quaternion,
        along(state.rate),
        along(state.acceleration),
        along(state.auxiliary),
        _cubic(middle(before), state.force, middle(after)),
        state.settling,
    )
    angles = jnp.cumsum(jnp.sqrt(jnp.sum(lax.stop_gradient(turn) ** 2, 1)))
    reached = jnp.interp(after, before, jnp.concatenate([jnp.zeros_like(angles[:1]), angles]))
    turned = jnp.max(jnp.diff(reached)) / (2 * jnp.pi)
    gap = lax.stop_gradient(new.position - along(state.position))
    spacing = jnp.maximum(jnp.max(length), jnp.max(rod.length))
    return new, ratio, turned, jnp.sqrt(jnp.max(jnp.sum(gap**2, 1))) / spacing


def _piece(grid, points):
    """Index of the interval of each point, its length, and the part of it passed."""
    i = jnp.clip(jnp.searchsorted(grid, points, side="right") - 1, 0, grid.shape[0] - 2)
    span = grid[i + 1] - grid[i]
    return i, span[:, None], ((points - grid[i]) / span)[:, None]


def _slopes(grid, values):
    """Derivatives at the points of a grid, of the parabola through each and its neighbours."""
    span = (grid[1:] - grid[:-1])[:, None]
    rise = (values[1:] - values[:-1]) / span
    if grid.shape[0] == 2:
        return jnp.concatenate([rise, rise])
    inner = (span[1:] * rise[:-1] + span[:-1] * rise[1:]) / (span[1:] + span[:-1])
    return jnp.concatenate([2 * rise[:1] - inner[:1], inner, 2 * rise[-1:] - inner[-1:]])


def _hermite(x, end, start_slope, end_slope):
    """The cubic from 0 to `end` with these slopes, at x in [0, 1]."""
    return x * (
        start_slope
        + x * ((3 * end - 2 * start_slope - end_slope) + x * (start_slope + end_slope - 2 * end))
    )


def _cubic(grid, values, points):
    """Values at other points, by cubics; the end ones serve beyond the grid."""
    i, span, x = _piece(grid, points)
    slopes = _slopes(grid, values)
    return values[i] + _hermite(
        x, values[i + 1] - values[i], span * slopes[i], span * slopes[i + 1]
    )


def _frames(quaternion, turn, before, after):
    """Frames along the arc length, with curvatures that are continuous at the old nodes."""
    span = (before[1:] - before[:-1])[:, None]
    middle = 0.5 * (before[1:] + before[:-1])
    curvature = _cubic(middle, turn / span, before)
    i, span, x = _piece(before, after)
    ends = rotations.tangent_inverse_apply(turn[i], curvature[i + 1])
    vector = _hermite(x, turn[i], span * curvature[i], span * ends)
    return rotations.normalize(rotations.multiply(quaternion[i], rotations.exponential(vector)))


def _stretch(state, rod, length):
    """gamma of the new elements: exactly e3 where they are rigid."""
    axial = jnp.asarray([0.0, 0.0, 1.0], rod.length.dtype)
    rigid = jnp.broadcast_to(axial, (rod.elements, 3))
    if rod.compliance is None:
        return rigid
    frames = rotations.matrix(element_quaternions(state.quaternion))
    edges = (state.position[1:] - state.position[:-1]) / length[:, None]
    stretch = jnp.einsum("nji,nj->ni", frames, edges)
    middle = jnp.cumsum(length) - 0.5 * length
    return jnp.where(rod.compliance > 0, _cubic(middle, stretch, rod.midpoints), rigid)


def _line(quaternion, stretch, rod):
    """Positions of the nodes from the first one on."""
    frames = rotations.matrix(element_quaternions(quaternion))
    edges = rod.length[:, None] * jnp.einsum("nij,nj->ni", frames, stretch)
    return jnp.concatenate([jnp.zeros_like(edges[:1]), jnp.cumsum(edges, 0)])


def _closed(quaternion, stretch, rod, reach):
    """Frames turned a little between the ends, so that the last node comes to its place.

    By window * (tangent x l), with l as Newton's method finds it; along a straight rod, where no
    small rotation reaches, nothing is done. Where Newton's method has converged its last step
    carries the whole derivative, so its matrix is held: the singular vectors of a straight rod
    have no derivative.
    """
    s = rod.arc_length / jnp.sum(rod.length)
    window = (4 * s * (1 - s))[:, None]

    def turned(l):
        push = window * jnp.cross(rotations.tangent_director(quaternion), l[None])
        return rotations.multiply(rotations.exponential(push), quaternion)

    def correct(_, l):
        miss = lambda l: _line(turned(l), stretch, rod)[-1] - reach
        matrix = lax.stop_gradient(jax.jacfwd(miss)(l))
        left, singular, right = jnp.linalg.svd(matrix)
        good = singular > 1e-2 * jnp.sum(rod.length)
        along = left.T @ miss(l) / jnp.where(good, singular, 1.0)
        return l - right.T @ jnp.where(good, along, 0.0)

    l = lax.fori_loop(0, _CORRECTIONS, correct, jnp.zeros_like(reach))
    return rotations.normalize(turned(l))
