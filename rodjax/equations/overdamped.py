"""Overdamped motion in a heat bath: no inertia, linear drag, and the noise that belongs to it.

With the drag Z of the nodes (6 x 6 each: forces in inertial axes, moments in body axes), x their
positions and frames, the motion obeys

    Z x' = loads(x) - inner(x) + sqrt(2 kT) Z^(1/2) xi(t),

inner the internal wrenches, xi white noise of variance 1. A step is the implicit midpoint rule,

    inner(x_m) - loads(x_m) + (2/dt) Z d - sqrt(2 kT/dt) Z^(1/2) xi = 0,    x_m = x_n (+) d,
    x_{n+1} = x_m (+) d,

whose unknown is the HALF increment d: of a frame its rotation vector, and the same again about the
same axis is the whole step. Of a linear mode of stiffness k, with a = k dt/Z, it gives

    x_{n+1} = (1 - a/2)/(1 + a/2) x_n + sqrt(2 kT dt/Z)/(1 + a/2) xi,   so   <x^2> = kT/k

exactly, whatever the step: an implicit Euler step would leave kT/(k (1 + a/2)). At a mode much
faster than the step x turns its sign in every step and forgets slowly, which costs independent
samples, not their distribution; but its mean over a step is too quiet, and so is what it exerts on
slower ones. Where it matters is measured in the documentation, not here.

**No drift besides.** The equilibrium of noise that depends on the configuration needs the drift
kT div M beyond the forces, M = Z^-1. It vanishes here, by three facts. The drag of a node depends
on its own frame alone, so M of the positions does not change with positions. In body axes M is
constant, and a rotation by a body-fixed rotation vector preserves the volume (Haar's measure) of
frames, so that noise in body axes has no drift in Stratonovich's sense, which is that of an
increment exp(d). And translation and rotation are not coupled through the noise of the other:
then Ito's and Stratonovich's sense agree, and Z may be taken where the step begins. What is
sampled is exp(-E/kT) in flat positions and Haar's measure of frames. (A drag with an offset from
its node couples both, and its M is constant in body axes alone: there Z where the step begins is
right to the order of dt only.)
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rodjax.equations.schemes import Change, FromReference, HalfStep, resisting


class Overdamped(FromReference):
    """A step of the midpoint rule without inertia; changes are half increments, see the module.

    Attributes:
        reference: positions and frames where the step begins.
        dt: the step [s].
        resistance: 2 Z/dt of the nodes.
        noise: sqrt(2 kT/dt) Z^(1/2) xi on them [N, N m].
    """

    dt: Float[Array, ""]
    resistance: Float[Array, "nodes 6 6"]
    noise: Change

    def slopes(self):
        return HalfStep(2 / self.dt, jnp.zeros_like(self.dt))

    def load_part(self):
        return None

    def turn_limit(self):
        return jnp.ones_like(self.dt)

    def lever(self, rod):
        return 1

    def exact_constraint(self):
        return False  # every element stretches: its constraint is a law like others

    def completed(self, change, wrench, constraint):
        drag = jnp.einsum("nij,nj->ni", self.resistance, change)
        return wrench + drag - self.noise, constraint

    def stiffened(self, change, node):
        return node + resisting(self.resistance, change)
