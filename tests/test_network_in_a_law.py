"""A law with functions in it, as an equinox MLP has its activation: all that a law goes through."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import rodjax as rx
from rodjax.dynamics.stepping import step
from rodjax.scenes.placing import placing


class Network(rx.AbstractLaw):
    """psi by a network of the distance."""

    net: eqx.nn.MLP

    def smallest(self, pair):
        return 0.2 * pair.diameter

    def repulsion(self, distance, approach, pair):
        return jax.nn.softplus(jnp.vectorize(lambda a: self.net(a[None])[0])(distance))


@pytest.mark.slow
def test_steps_are_traced_differentiated_and_batched():
    rod = rx.straight_rod(1.0, 8, rx.Section((1.0, 1.0, 1.0), mass=0.1, diameter=0.01))
    law = Network(eqx.nn.MLP(1, 1, 4, 1, key=jax.random.key(0)))
    scene = rx.Scene(rod, rx.Clamped(), contact=rx.Contact(law, segments=8, cutoff=0.1))
    arrays, rest = eqx.partition(scene, eqx.is_array)

    def moved(arrays):
        whole = eqx.combine(arrays, rest)
        return step(whole, placing(whole), jnp.asarray(1e-3))[0].position

    assert jax.eval_shape(moved, arrays).shape == (9, 3)
    slope = jax.eval_shape(jax.grad(lambda arrays: jnp.sum(moved(arrays))), arrays)
    assert len(jax.tree.leaves(slope)) == len(jax.tree.leaves(arrays))
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), arrays)
    assert jax.eval_shape(jax.vmap(moved), two).shape == (2, 9, 3)
