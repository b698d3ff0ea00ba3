"""Users' loads and ends that do what the equations have no place for are refused."""

import gc
import time
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION

from rodjax import rotations
from rodjax.constraints.ends import AbstractEnd, Clamped
from rodjax.interactions.load import AbstractLoad
from rodjax.interactions.loads import DistributedLoad, Gravity
from rodjax.rods.builders import straight_rod
from rodjax.scenes import probing
from rodjax.scenes.scene import Scene

ROD = straight_rod(1.0, 6, UNIT_SECTION)
Z = jnp.asarray([0.0, 0.0, 1.0])


def spread(force):
    """Force per length without moment."""
    return jnp.concatenate([force, jnp.zeros_like(force)], 1)


def with_load(function, parameters=None, rod=ROD):
    return Scene(rod, loads=(Gravity(Z), DistributedLoad(function, parameters)))


NEIGHBOURS = {
    "mean": lambda p, s, m: spread(jnp.mean(m.position, 0)[None] - m.position),
    "sum of velocities": lambda p, s, m: spread(-jnp.sum(m.velocity, 0)[None] + 0 * m.velocity),
    "difference": lambda p, s, m: spread(jnp.gradient(m.position, axis=0)),
    "next": lambda p, s, m: spread(m.position - jnp.roll(m.position, -1, 0)),
    "next but one": lambda p, s, m: spread(m.position - jnp.roll(m.position, 2, 0)),
    "first node": lambda p, s, m: spread(m.position - m.position[:1]),
    "last on first": lambda p, s, m: spread(0 * m.velocity).at[0, :3].set(m.velocity[-1]),
    "mirror": lambda p, s, m: spread(m.velocity[::-1]),
    "largest speed": lambda p, s, m: spread(-m.velocity * jnp.max(jnp.abs(m.velocity))),
    "spin": lambda p, s, m: spread(0 * s[:, None] + m.angular_velocity[2:3]),
    "frames": lambda p, s, m: spread(rotations.tangent_director(m.quaternion[::-1])),
    "in reach": lambda p, s, m: spread(
        jnp.sum(jnp.exp(-1e4 * (m.position[:, None] - m.position[None]) ** 2), 1)
    ),
    "late": lambda p, s, m: spread(
        jnp.where(m.time > 100, jnp.mean(m.position, 0)[None], 0 * m.position)
    ),
    "weak": lambda p, s, m: spread(1e6 - m.position + 1e-3 * jnp.mean(m.position, 0)[None]),
    "scan": lambda p, s, m: spread(jnp.cumsum(m.velocity, 0)),
    "now nothing": lambda p, s, m: spread(p * jnp.mean(m.position, 0)[None] + 0 * m.position),
}


@pytest.mark.parametrize("kind", NEIGHBOURS)
def test_loads_that_look_at_other_nodes_are_refused(kind):
    with pytest.raises(ValueError, match=r"loads\[1\] \(DistributedLoad of .*: the wrench on node"):
        with_load(NEIGHBOURS[kind], 0.0)


def test_the_message_names_both_nodes():
    with pytest.raises(ValueError, match="node 0, .* changes with the motion of node 6, ") as got:
        with_load(NEIGHBOURS["last on first"])
    assert got.type is ValueError  # no private class in a user's traceback


class ToMean(AbstractLoad):
    """A spring of every node to the mean of all."""

    stiffness: jax.Array

    def wrench(self, rod, motion):
        gap = motion.position - jnp.mean(motion.position, 0)[None]
        return rod.node_length[:, None] * spread(-self.stiffness * gap)


class SharedMass(AbstractLoad):
    """Added mass that depends on all frames."""

    amount: float = 1.0

    @property
    def inertia(self):
        return True

    def wrench(self, rod, motion):
        return jnp.zeros((rod.elements + 1, 6))

    def added_mass(self, rod, motion):
        tangent = rotations.tangent_director(motion.quaternion)
        return self.amount * (jnp.eye(3)[None] + 0 * tangent[:, :, None] + jnp.mean(tangent))


def test_users_classes_too():
    for load in (ToMean(jnp.asarray(2.0)), ToMean(0.0), SharedMass()):
        with pytest.raises(ValueError, match=rf"loads\[0\] \({type(load).__name__}\): the wrench"):
            Scene(ROD, loads=(load,))


def test_in_traced_code_too():
    """A parameter, a rod or what a function has around it may be what is traced."""

    def total(k, load, length=1.0):
        rod = eqx.tree_at(lambda rod: rod.length, ROD, length * ROD.length)
        scene = Scene(rod, loads=(load(k),))
        return jnp.sum(scene.loads[0].wrench(rod, motion_of(rod)) ** 2)

    around = lambda k: DistributedLoad(lambda p, s, m: spread(k * jnp.mean(m.position) + 0 * m[1]))
    right = lambda k: DistributedLoad(lambda p, s, m: spread(-k * m.position))
    for run in (jax.jit, jax.grad, jax.jacfwd, jax.vmap):
        for load in (ToMean, around):
            with pytest.raises(ValueError, match="node's own row"):
                run(lambda k, load=load: total(k, load))(jnp.ones(2)[0] if run != jax.vmap else Z)
    assert np.isfinite(jax.jit(jax.grad(lambda k: total(k, right, k)))(2.0))


def motion_of(rod):
    from rodjax.rods.state import NodeMotion

    still = jnp.zeros_like(rod.position)
    return NodeMotion(jnp.asarray(0.0), rod.position, rod.quaternion, still, still)


def kicks(p, s, m):
    """Discontinuous in all it may look at."""
    force = jnp.where(m.position > 0, jnp.sign(m.velocity), 3.0) * jnp.floor(m.time)
    return spread(jnp.where(s[:, None] > 0.4, force, -force))


OWN = {
    "nothing": lambda p, s, m: spread(0 * m.position),
    "s and time": lambda p, s, m: spread(jnp.sin(s * m.time)[:, None] + 0 * m.position),
    "jumps": kicks,
    "not a number": lambda p, s, m: spread(jnp.log(m.position) + jnp.sqrt(m.velocity)),
    "infinite": lambda p, s, m: spread(m.position / 0.0),
    "frames": lambda p, s, m: spread(rotations.rotate(m.quaternion, m.velocity * s[:, None])),
    "numbers of all nodes": lambda p, s, m: spread((p["field"] - m.position) * jnp.mean(s)),
    "where it lies at rest": lambda p, s, m: spread(jnp.mean(s) - m.position + jnp.sum(p["field"])),
    "a net": lambda p, s, m: jax.vmap(p["net"])(jnp.concatenate([m.position, m.velocity], 1)),
    "one by one": lambda p, s, m: jax.lax.map(lambda v: jnp.concatenate([v, v]), m.velocity),
}


@pytest.mark.parametrize("kind", OWN)
def test_loads_of_their_own_node_pass(kind):
    field = jnp.asarray(np.random.default_rng(0).normal(size=(7, 3)))
    net = eqx.nn.MLP(6, 6, 8, 2, key=jax.random.key(0))
    with_load(OWN[kind], {"field": field, "net": net})


def test_a_kind_is_probed_once():
    """Other numbers and other grids cost nothing."""
    calls = []

    def load(p, s, m):
        calls.append(1)
        return spread(-p * m.position)

    begin = time.perf_counter()
    with_load(load, 1.0)
    assert time.perf_counter() - begin < 2.0 and len(calls) == 1
    with_load(load, 2.0)
    with_load(load, 2.0, straight_rod(1.0, 9, UNIT_SECTION))
    assert len(calls) == 1


def own(motion):
    return -motion.position


def neighbours(motion):
    return -jnp.roll(motion.position, 1, 0)


def test_what_functions_and_indices_are_given_belongs_to_the_kind():
    by_function = lambda p, s, m: spread(p(m))
    with_load(by_function, own)
    by_index = lambda p, s, m: spread(-p["of"] * m.position[p["at"]])
    total = lambda m: jnp.sum(m.position, 0)[None] + 0 * m.velocity
    by_mask = lambda p, s, m: spread(jnp.where(p, total(m), 0.0))
    with_load(by_index, {"of": 1.0, "at": jnp.arange(7)})
    with_load(by_mask, jnp.zeros((7, 1), bool))
    for function, parameters in (
        (by_function, neighbours),
        (by_index, {"of": 1.0, "at": np.roll(np.arange(7), 1)}),
        (by_mask, jnp.ones((7, 1), bool)),
    ):
        with pytest.raises(ValueError, match="the wrench on node"):
            with_load(function, parameters)


class Listed(AbstractLoad):
    """A load with a static field that cannot be hashed."""

    shift: list = eqx.field(static=True)

    def wrench(self, rod, motion):
        return spread(-jnp.roll(motion.position, self.shift[0], 0))


def test_a_kind_without_hash_is_probed_each_time():
    shift = [0]
    Scene(ROD, loads=(Listed(shift),))
    shift[0] = 1
    with pytest.raises(ValueError, match="the wrench on node"):
        Scene(ROD, loads=(Listed(shift),))


def test_few_functions_are_kept_alive(monkeypatch):
    monkeypatch.setattr(probing, "_KEPT", 2)

    class Around:
        """Something large that a load has around it."""

    kept = []
    for _ in range(5):
        around = Around()
        kept.append(weakref.ref(around))
        with_load(lambda p, s, m, around=around: spread(0 * m.position))
        del around
    jax.clear_caches()
    gc.collect()
    assert sum(one() is not None for one in kept) == 2


def test_a_diagonal_matrix_is_refused_for_its_zeros():
    """They may be changed later, by a fit, without another check."""
    function = lambda p, s, m: spread(-p @ m.position)
    with pytest.raises(ValueError, match="Give a diagonal as a vector"):
        with_load(function, 3.0 * jnp.eye(7))
    with pytest.raises(ValueError, match="belong in `contact`$"):
        with_load(function, jnp.ones((7, 7)))
    masked = lambda p, s, m: spread(-jnp.where(p["here"], p["k"], 0.0) @ m.position)
    with_load(masked, {"k": 3.0 * jnp.eye(7), "here": jnp.eye(7, dtype=bool)})


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda p, s, m: jnp.zeros((7, 3)), r"must have shape \(7, 6\), .* got \(7, 3\)"),
        (lambda p, s, m: jnp.zeros(()), r"must have shape \(7, 6\), .* got \(7, 1\)"),
        (lambda p, s, m: jnp.zeros((6, 6)), "fails when it is traced, by TypeError.* jax.numpy"),
        (lambda p, s, m: np.sin(m.position), "fails when it is traced, by TracerArrayConversion"),
        (lambda p, s, m: [1.0] * 6, "fails when it is traced"),
        (lambda p, s, m: p["speed"], "fails when it is traced"),
        (lambda p, s: s, "fails when it is traced, by TypeError"),
    ],
)
def test_functions_that_give_no_wrench_are_refused(function, message):
    with pytest.raises(ValueError, match=message) as raised:
        with_load(function)
    assert raised.type is ValueError


# Ends


class End(AbstractEnd):
    """An end with a projector by a function of time."""

    function: object = eqx.field(static=True)
    times: tuple = ()
    displacement: None = None
    rotation: None = None

    def projector(self, time):
        return self.function(time)

    @property
    def switch_times(self):
        return self.times


def along(axis):
    axis = jnp.asarray(axis)
    return jnp.zeros((6, 6)).at[:3, :3].set(jnp.outer(axis, axis))


turning = lambda t: along([jnp.cos(t), jnp.sin(t), 0.0])
late = lambda t: jnp.where(t >= 2.0, 1.0, 0.0) * jnp.eye(6)
mixed = 0.5 * jnp.ones((6, 6)).at[1:3].set(0).at[:, 1:3].set(0).at[4:].set(0).at[:, 4:].set(0)
BAD = {
    "turns": (turning, (), "first_end .End.: its projector changes between"),
    "switches unsaid": (late, (), "changes between"),
    "switches later": (late, (1.0,), "changes between"),
    "turns after": (lambda t: jnp.where(t < 2.0, along(Z), turning(t)), (2.0,), "changes between"),
    "not of unit length": (lambda t: along([0.0, 0.0, 2.0]), (), "must be orthogonal"),
    "not symmetric": (lambda t: jnp.eye(6).at[0, 1].set(1.0), (), "must be orthogonal"),
    "negative": (lambda t: -jnp.eye(6), (), "must be orthogonal"),
    "mixes": (lambda t: mixed, (), "mixes translations"),
    "small": (lambda t: jnp.eye(3), (), r"must have shape \(6, 6\)"),
    "not a number": (lambda t: jnp.nan * jnp.eye(6), (), "must be finite"),
}


@pytest.mark.parametrize("kind", BAD)
def test_ends_that_the_equations_do_not_know_are_refused(kind):
    function, times, message = BAD[kind]
    with pytest.raises(ValueError, match=message):
        Scene(ROD, End(function, tuple(map(jnp.asarray, times))), Clamped())


def test_right_ends_pass():
    Scene(ROD, End(late, (jnp.asarray(2.0),)), End(lambda t: along([0.6, 0.0, 0.8])))
    Scene(ROD, End(lambda t: jnp.zeros((6, 6))), End(lambda t: jnp.eye(6)))
