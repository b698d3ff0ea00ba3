"""A rod in a heat bath at one time, and what a step of it tells."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rodjax.dynamics.bath import check_thermal
from rodjax.rods import balance
from rodjax.rods.rod import Rod
from rodjax.rods.state import State, at_rest
from rodjax.rods.strains import strains
from rodjax.scenes.arguments import check_motion, check_scene
from rodjax.scenes.placing import placing
from rodjax.scenes.scene import Scene


class ThermalState(eqx.Module):
    """A rod in a heat bath at one time.

    Attributes:
        state: its `State`; rates and accelerations in it are zero, and its `force` is that of the
            stretch and shear at this instant.
        key: of `jax.random`, from which the noise of the next step is drawn, and the key after it.
        white: (n+1, 6), the noise that was drawn last, of variance 1; explicit steps use it again.

    Example:
        >>> soft = rx.yielding(rod)
        >>> drag = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
        >>> bathed = rx.thermal_start(rx.Scene(soft, loads=(drag,)), jax.random.key(0))
        >>> bathed.state.position.shape
        (21, 3)
    """

    state: State
    key: Any
    white: Float[Array, "nodes 6"]


class ThermalStepInfo(NamedTuple):
    """What a step in a heat bath reports besides the new state.

    Attributes:
        result: a `Result` as a number; 0 is success.
        iterations: of Newton's method.
        moved: largest displacement of a node in the step [m].
        turned: largest rotation of a node in the step [rad].
    """

    result: Int[Array, ""]
    iterations: Int[Array, ""]
    moved: Float[Array, ""]
    turned: Float[Array, ""]


def thermal_start(scene: Scene, key: Any, state: State | None = None) -> ThermalState:
    """A rod in a heat bath where it is placed, or at a state, with the key of its noise.

    It is not yet in equilibrium with the bath: let it run first, by some times its slowest
    relaxation.

    Args:
        scene: the rod with what holds it and acts on it; its loads must have drag.
        key: of `jax.random`; under `vmap` over keys each replica has its own noise.
        state: where to begin; by default as the rod was placed.

    Raises:
        ValueError: the scene has no equilibrium with a bath, see the message.

    Example:
        >>> soft = rx.yielding(rod)
        >>> drag = rx.LinearDrag(normal=0.2, tangential=0.1, rotational=1e-6)
        >>> bathed = rx.Scene(soft, rx.Clamped(), loads=(drag,))
        >>> keys = jax.random.split(jax.random.key(0), 3)
        >>> jax.vmap(lambda key: rx.thermal_start(bathed, key))(keys).state.position.shape
        (3, 21, 3)
    """
    check_scene(scene)
    check_thermal(scene)
    if state is None:
        state = placing(scene)
    check_motion(scene, state)
    zero = jnp.zeros_like(state.rate)
    still = dataclasses.replace(
        state,
        rate=zero,
        acceleration=zero,
        auxiliary=zero,
        settling=None,
        jerk=None,
        memory=None,
        joints=None,
    )
    force = elastic_force(scene.rod, still.time, still.position, still.quaternion)
    key, drawn = jax.random.split(key)
    white = jax.random.normal(drawn, zero.shape, zero.dtype)
    return ThermalState(dataclasses.replace(still, force=force), key, white)


def elastic_force(rod: Rod, time, position, quaternion) -> Float[Array, "n 3"]:
    """Internal force of a rod that stretches and shears, by its strain alone."""
    assert rod.compliance is not None
    kinematics = strains(rod, position, quaternion)
    strain = balance.force_strain(rod, kinematics, at_rest(time, position, quaternion))
    return strain / rod.at_breaks(rod.compliance, 1.0)
