"""Small undamped motion about an equilibrium: frequencies of vibration and rates of growth."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rodjax.compilation import compiled
from rodjax.inertia import inertial_wrench, node_jacobian
from rodjax.linear_stability import check_count, lowest, reduced_tangent
from rodjax.load_path import check_held
from rodjax.scene import Scene
from rodjax.state import State
from rodjax.statics import at_rest


class Vibration(NamedTuple):
    """Modes exp(i omega t) of the linearised motion, omega^2 ascending."""

    squared: Float[Array, " k"]  # omega^2 [1/s^2], negative for a growing mode
    modes: Float[Array, "k nodes 6"]  # displacement and body spin of the nodes, of unit modal mass

    @property
    def frequency(self) -> Float[Array, " k"]:
        """Angular frequency omega of each mode [1/s]; zero for one that grows."""
        return _root(self.squared)

    @property
    def growth_rate(self) -> Float[Array, " k"]:
        """Rate sigma of each mode that grows as exp(sigma t) [1/s]; zero for one that vibrates."""
        return _root(-self.squared)


def _root(x):
    """Square root where positive, else zero, with finite derivatives."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


def vibration(scene: Scene, state: State, count: int = 1) -> Vibration:
    """The `count` modes of lowest omega^2 about an equilibrium: K x = omega^2 M x.

    K is the symmetric part of the tangent on the motions that constraint and ends allow (see
    `stability`), M the mass of the nodes with rotary inertia, if the rod has it, and added mass.
    Drag is left out. Frequencies can be differentiated, modes cannot. Dense: cost grows as n^3,
    and round-off of omega^2 as n^4, meant for up to a few hundred elements.

    Raises:
        ValueError: the rod has no mass, the ends leave it free to move, or `count` does not fit.
    """
    if scene.rod.mass is None:
        raise ValueError("mass: a rod with mass=None does not vibrate; give its section a mass")
    check_held(scene, state)
    check_count(scene, count)
    return _vibration(scene, state, count)


@compiled
def _vibration(scene, state, count):
    rod = scene.rod
    reduced = reduced_tangent(scene, state)
    motion = at_rest(state.time, state.position, state.quaternion)
    zero = jnp.zeros_like(state.rate)
    matrix = node_jacobian(lambda rate: inertial_wrench(scene, motion, rate), zero)
    m = reduced.basis.shape[0]
    pushed = jnp.einsum("nij,mnj->mni", matrix, reduced.basis)
    mass = reduced.basis.reshape(m, -1) @ pushed.reshape(m, -1).T
    bend, length = jnp.mean(rod.stiffness[:, :2]), jnp.sum(rod.length)
    unit = 100 * bend / (jnp.mean(rod.mass) * length**4)
    squared, y = lowest(reduced.stiffness, mass, reduced.ends, unit, count)
    return Vibration(squared, jnp.einsum("km,mni->kni", y, lax.stop_gradient(reduced.basis)))
