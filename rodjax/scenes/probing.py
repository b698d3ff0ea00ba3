"""What a user's loads and ends must keep to, probed by numbers when a scene is made.

The equations have a block a node for the loads, or three with those beside it, and ends that change
at their switch times only: a load that looked at other nodes, or an end that turned in between,
would run on with wrong derivatives or a wrong motion.
"""

import hashlib

import equinox as eqx
import jax
import jax.core
import jax.extend.core
import jax.numpy as jnp
import numpy as np

from rodjax.constraints.ends import AbstractEnd
from rodjax.interactions.load import AbstractLoad
from rodjax.numerics.results import STEP_FAILED
from rodjax.rods.rod import Rod
from rodjax.rods.state import NodeMotion

_ERRORS = (ArithmeticError, LookupError, TypeError, ValueError, *STEP_FAILED)

# Kinds of loads that have passed, the one used last at the end; few, for they keep alive what a
# user's functions have around them.
_PASSED: dict = {}
_KEPT = 32

# Those of the library keep to it.
_OWN = "rodjax."

_OF_ZEROS = (
    ". (With the zeros among its parameters as they are it does not; but real numbers may change"
    " later, unchecked. Give a diagonal as a vector, or multiply by truth values, which stay)"
)


def check_local(load: AbstractLoad, rod: Rod, name: str) -> None:
    """Raise ValueError if a node's wrench or added mass changes with another node's motion.

    That of a load that acts `between_nodes` may change with the nodes beside it in its rod. All
    nodes but some are moved, and the rows of those must stay as they were; for every two nodes
    there is a set that holds the one (and those beside it) but not the other. In traced code too:
    the program of the wrench is run with stand-ins for what is traced, and for zeros, that may hide
    something. Rows that are not finite tell nothing, nor does a function that cannot be traced.
    """
    function = getattr(load, "function", None)
    if type(load).__module__.startswith(_OWN) and function is None:
        return
    kind = _kind(load)
    if kind is not None and load.between_nodes:
        kind = kind, rod.breaks  # across which nodes are not beside each other
    if kind in _PASSED:
        _PASSED[kind] = _PASSED.pop(kind)
        return
    of = "" if function is None else f" of {getattr(function, '__qualname__', function)}"
    title, nodes = f"{name} ({type(load).__name__}{of})", rod.elements + 1
    generator = np.random.default_rng(0)
    try:
        rows, lasting = _program(load, rod, generator, title)
        for scale in (1.0, 1e-3):  # far from each other, and close
            one, other = (_motion(rod, scale, generator) for _ in range(2))
            before = rows(one)
            for kept, inside, reach, looked in _sets(rod, load.between_nodes):
                differ = lambda rows, other, looked=looked: _differ(
                    rows[:, looked], other[:, looked]
                )
                changed = inside & differ(before, rows(_mixed(kept, one, other)))
                if np.any(changed):
                    node = int(np.argmax(changed))
                    alone = (_mixed(np.arange(nodes) != j, one, other) for j in range(nodes))
                    moved = [differ(before, rows(motion))[node] for motion in alone]
                    moved = moved & ~_near(rod, node, reach)
                    which = f"node {np.argmax(moved)}" if any(moved) else "other nodes"
                    given, _ = _program(load, rod, generator, title, zeros_stay=True)
                    moving = differ(given(one), given(_mixed(kept, one, other)))
                    raise _Refused(
                        f"{title}: the wrench on node {node}, or the mass added to it, changes with"
                        f" the motion of {which}, for which the equations of a step have no place;"
                        f" use {_ALLOWED[reach]}. Forces between strands belong in `contact`"
                        + ("" if np.any(inside & moving) else _OF_ZEROS)
                    )
    except _Refused as refusal:  # the caller's traceback names no private class
        raise ValueError(*refusal.args) from refusal.__cause__
    except _ERRORS:
        return
    if kind is not None and lasting:
        _PASSED[kind] = None
        while len(_PASSED) > _KEPT:
            del _PASSED[next(iter(_PASSED))]


def _kind(load: AbstractLoad):
    """What the outcome of the probe hangs on, to be remembered by; None where that cannot be.

    That is the structure of the pytree with its static functions, the functions and Python's values
    among its leaves, and the values of whole numbers and truth values, which may be indices and
    masks. Of real numbers the probe does without, and knows their shapes only.
    """
    leaves, structure = jax.tree.flatten(load)
    try:
        kind = (structure, *map(_of_leaf, leaves))
        hash(kind)
        _hash_static(structure)
    except TypeError:  # something that may change, or cannot be told from others
        return None
    return kind


def _hash_static(structure) -> None:
    """Raise TypeError where a static field has no hash, which the hash of a structure passes by."""
    data = structure.node_data()
    if data is not None and not isinstance(data[1], list):  # the names of a dictionary
        hash(data[1])
    for child in structure.children():
        _hash_static(child)


def _of_leaf(leaf):
    if not eqx.is_array_like(leaf) or isinstance(leaf, bool | int | float | complex):
        return type(leaf), leaf
    shape, dtype = np.shape(leaf), leaf.dtype
    if isinstance(leaf, jax.core.Tracer) or jnp.issubdtype(dtype, jnp.inexact):
        return shape, str(dtype)
    return shape, str(dtype), hashlib.sha256(np.asarray(leaf).tobytes()).digest()


# What rows of the motion may be used, as far along the rod as this.
_ALLOWED = (
    "the node's own row of `motion` only (no mean, sum, difference or shift along the nodes)",
    "for its wrench the rows of `motion` of the node and of those beside it in its rod only",
)


class _Refused(ValueError):
    pass


def _program(load, rod, generator, title, zeros_stay=False):
    """What is looked at, in one row a node, as a function of the motion's numbers.

    Besides, whether it holds nothing that is traced: what does is met but once.
    """
    nodes = rod.elements + 1

    def rows(arrays, motion):
        load, rod = eqx.combine(arrays, rest)
        motion = NodeMotion(*motion)
        wrench, mass = load.wrench(rod, motion), load.added_mass(rod, motion)
        if jnp.shape(wrench) != (nodes, 6):
            raise _Refused(
                f"{title}: the wrench must have shape {(nodes, 6)}, force and moment of every node,"
                f" got {jnp.shape(wrench)}"
            )
        parts = [wrench] if mass is None else [wrench, mass]
        return jnp.concatenate([jnp.reshape(part, (nodes, -1)) for part in parts], 1)

    arrays, rest = eqx.partition((load, rod), eqx.is_array)
    try:
        closed = jax.make_jaxpr(rows)(arrays, _motion(rod, 1.0, generator))
    except _Refused:
        raise
    except _ERRORS as error:  # real ones, for nothing has been replaced yet
        raise _Refused(
            f"{title}: it fails when it is traced, by {type(error).__name__}: {error}. It must use"
            f" jax.numpy on the arrays of `motion`, and give {(nodes, 6)}"
        ) from error
    stand_in = lambda value: _stand_in(value, generator, zeros_stay)
    lasting = not any(isinstance(x, jax.core.Tracer) for x in closed.consts)
    with jax.ensure_compile_time_eval():
        given = [stand_in(leaf) for leaf in jax.tree.leaves(arrays)]
        # what a function takes from around it may be traced too
        closed = jax.extend.core.ClosedJaxpr(closed.jaxpr, [stand_in(x) for x in closed.consts])
        program = jax.jit(jax.extend.core.jaxpr_as_fun(closed))

    def run(motion):
        with jax.ensure_compile_time_eval():
            return np.asarray(program(*given, *motion)[0])

    return run, lasting


def _stand_in(value, generator, zeros_stay):
    """A known value with other numbers for zeros; for a traced one positive numbers near one."""
    shape, dtype = np.shape(value), value.dtype
    if not jnp.issubdtype(dtype, jnp.floating):
        return jnp.zeros(shape, dtype) if isinstance(value, jax.core.Tracer) else value
    drawn = generator.uniform(0.5, 1.5, shape)
    if not isinstance(value, jax.core.Tracer):
        drawn = value if zeros_stay else np.where(np.asarray(value) == 0, drawn, value)
    return jnp.asarray(drawn, dtype)


def _motion(rod, scale, generator):
    """Time, positions, frames, velocities and angular velocities of the nodes, at random."""
    nodes, dtype = rod.elements + 1, rod.position.dtype
    frames = generator.normal(size=(nodes, 4))
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    other = [generator.normal(size=(nodes, 3)) for _ in range(3)]
    parts = (0.3 / scale, scale * other[0], frames, *other[1:])
    return tuple(np.asarray(part, dtype) for part in parts)


def _mixed(kept, one, other):
    """Motion `one` of the nodes kept, `other` of the rest."""
    pick = lambda a, b: np.where(kept[:, None], a, b)
    return (one[0], *map(pick, one[1:], other[1:]))


# Columns of what is looked at: the wrench, then the mass that is added.
_ALL, _MASS = slice(None), slice(6, None)


def _sets(rod, between_nodes):
    """Sets of nodes that stay, which of them have all stay that they may hang on, how far that
    reaches, and in what columns.

    Of any two nodes of which the first may not hang on the second, a set holds the first inside
    but not the second.
    """
    nodes = np.arange(rod.elements + 1)
    own = _MASS if between_nodes else _ALL
    yield from ((*sets, 0, own) for sets in _halves(nodes, np.ones_like(nodes, bool)))
    if not between_nodes:
        return
    rods = np.repeat(range(len(rod.parts)), [part.last - part.first + 1 for part in rod.parts])
    for shift in range(3):
        # groups of three nodes of a rod, a node in the middle of one of them
        group = np.unique(rods * len(nodes) + (nodes + shift) // 3, return_inverse=True)[1]
        apart = (group[1:] != group[:-1]) & (rods[1:] == rods[:-1])
        inside = ~(np.append(apart, False) | np.append(False, apart))
        yield from ((*sets, 1, _ALL) for sets in _halves(group, inside))


def _halves(group, inside):
    """Sets of whole groups, of which for any two one holds the first but not the second."""
    for bit in range(int(group[-1]).bit_length()):
        marked = (group >> bit & 1).astype(bool)
        yield from ((kept, kept & inside) for kept in (marked, ~marked))


def _near(rod, node, reach):
    """The nodes so far from one."""
    near = np.zeros(rod.elements + 1, bool)
    part = next(part for part in rod.parts if part.first <= node <= part.last)
    near[max(node - reach, part.first) : min(node + reach, part.last) + 1] = True
    return near


def _differ(before, after):
    """Which rows have changed by more than rounding."""
    with np.errstate(all="ignore"):
        size = np.max(np.abs(before), 1, where=np.isfinite(before), initial=0.0)
        change = np.nanmax(np.abs(after - before), 1, initial=0.0)
    return change > 1e3 * np.finfo(before.dtype).eps * size


def check_end(end: AbstractEnd, name: str) -> None:
    """Raise ValueError unless an end takes directions away as the equations have it.

    Its projector is orthogonal, mixes no translation with a rotation, and changes at the switch
    times only. Skipped where the end is traced.
    """
    if type(end).__module__ == AbstractEnd.__module__:  # those of the library do
        return
    title = f"{name} ({type(end).__name__})"
    with jax.ensure_compile_time_eval():
        marks = [jnp.asarray(time) for time in end.switch_times]
        at = lambda time: end.projector(jnp.asarray(time, jnp.result_type(float)))
        if any(isinstance(x, jax.core.Tracer) for x in (*marks, at(0.0))):
            return
        marks = sorted(map(float, marks))
        first, last = (marks[0], marks[-1]) if marks else (0.0, 0.0)
        size = max(1.0, abs(first), abs(last))
        edges = [first - 10 * size, *marks, last + 10 * size]
        for begin, stop in zip(edges[:-1], edges[1:], strict=True):
            # a switch belongs to what follows it
            times = [begin + part * (stop - begin) for part in (0.0, 1e-3, 0.1, 0.37, 0.999)]
            found = [np.asarray(at(time), float) for time in times]
            _check_projector(found[0], title)
            for time, other in zip(times, found, strict=True):
                if not np.allclose(other, found[0], atol=1e-5):
                    raise ValueError(
                        f"{title}: its projector changes between {times[0]:g} and {time:g}, with no"
                        " switch time there; give every change in `switch_times`, and move the end"
                        " by its displacement and rotation"
                    )


def _check_projector(projector, title):
    if projector.shape != (6, 6):
        raise ValueError(f"{title}: the projector must have shape (6, 6), got {projector.shape}")
    if not np.all(np.isfinite(projector)):
        raise ValueError(f"{title}: the projector must be finite, got {projector}")
    same = lambda a, b: np.allclose(a, b, atol=1e-5)
    if not (same(projector, projector.T) and same(projector @ projector, projector)):
        raise ValueError(
            f"{title}: the projector must be orthogonal (symmetric, and its own square); of unit"
            " directions d it is the sum of the outer products d d^T"
        )
    if not same(projector[:3, 3:], 0.0):
        raise ValueError(
            f"{title}: the projector mixes translations (inertial axes) with rotations (body axes);"
            " the blocks [:3, 3:] and [3:, :3] must be zero"
        )
