# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A law that is learnt
#
# How does a fluid resist a thread that moves through it? In water by the square of the speed; but
# in a polymer solution, which thins as it is sheared, nobody hands one a formula. What can be
# seen is how a thread swings in it. Here a small neural network takes the place of the law of
# drag inside of a scene, and learns it from the positions of a few markers, through the motion:
# no force is measured.
#
# The data are made by a known law, so that what was learnt can be laid beside it.

# %%
# %matplotlib inline
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## A load of one's own
#
# A load is a class with a `wrench`: force and moment on every node, from the node's own motion.
# This one acts across the thread, with the force $-c(|v|)\, v$ per length; what $c$ is is left to
# two subclasses, the law that makes the data and the network. Its `role` tells the energy ledger
# what its work is. Newton's method gets the derivative from jax.


# %%
class Resistance(rx.AbstractLoad):
    """-c(|v|) v per length, v the velocity across the thread."""

    def coefficient(self, speed):
        """c [N s/m^2] at speeds [m/s]."""
        raise NotImplementedError

    @property
    def role(self):
        return rx.Role.DRAG

    def wrench(self, rod, motion):
        tangent = rx.rotations.tangent_director(motion.quaternion)
        along = jnp.sum(motion.velocity * tangent, 1, keepdims=True)
        across = motion.velocity - along * tangent
        speed = jnp.sqrt(jnp.sum(across**2, 1) + 1e-6)  # smooth where nothing moves
        force = -rod.node_length[:, None] * self.coefficient(speed)[:, None] * across
        return jnp.concatenate([force, jnp.zeros_like(force)], 1)


class Thinning(Resistance):
    """A fluid that thins as it is sheared (Carreau 1972): thick at rest, thinner beyond 30 mm/s."""

    def coefficient(self, speed):
        return 0.5 + 11.5 * (1 + (speed / 0.03) ** 2) ** -0.4


class Learnt(Resistance):
    """c by a network of the speed, always positive."""

    net: eqx.nn.MLP

    def coefficient(self, speed):
        return 4.0 * jnp.exp(jax.vmap(self.net)(0.5 * jnp.log(speed / 0.1)[:, None])[:, 0])


# %% [markdown]
# ## The experiment
#
# A rubber thread of 1 m is clamped at one end, held out level and let go. Four markers are seen,
# each to 1 mm, at twenty times.

# %%
section = rx.circular_section(0.01, youngs_modulus=1.2e7, shear_modulus=4e6, density=1500.0)
rod = rx.straight_rod(1.0, 20, section, direction=(1, 0, 0))
weight = rx.Gravity((0, 0, -9.81), fluid_density=1000.0)
steps, pictures = np.linspace(0.0, 4.0, 81)[1:], np.linspace(0.2, 4.0, 20)  # [s]


def moved(drag, velocity):
    scene = rx.Scene(rod, rx.Clamped(), loads=(weight, drag))
    return rx.rollout(scene, rx.start(scene, velocity=velocity), steps, throw=False)


def seen(run):
    return rx.positions_at(run, pictures)[:, 5::5]


motion, still = rx.jit(moved), jnp.zeros((21, 3))  # [m/s] of the nodes at first
run = motion(Thinning(), still)
noise = 1e-3  # [m]
exact = np.asarray(seen(run))
data = exact + noise * np.random.default_rng(0).normal(size=exact.shape)
scene = rx.Scene(rod, rx.Clamped(), loads=(weight, Thinning()))
rx.view(scene, run, frames=100, colour="speed", title="A thread let go in a thick fluid")

# %% [markdown]
# ## Learning
#
# The loss is chi squared for each number seen: near 1 when what is left is noise. `minimize` goes
# down along its gradient, taken in reverse mode through the whole motion, by any optimizer of
# optax; L-BFGS, which learns the curvature of the loss, suits a smooth one of few weights.

# %%
net = eqx.nn.MLP(1, 1, width_size=6, depth=1, activation=jnp.tanh, key=jax.random.key(0))
weights, rest = eqx.partition(net, eqx.is_array)


def loss(weights):
    run = moved(Learnt(eqx.combine(weights, rest)), still)
    return jnp.mean(((seen(run) - data) / noise) ** 2)


count = sum(leaf.size for leaf in jax.tree.leaves(weights))
best = rx.minimize(loss, weights, optimizer=optax.lbfgs(), max_steps=60)
learnt = Learnt(eqx.combine(best.parameters, rest))
print(f"{count} weights, {data.size} numbers seen")
print(f"chi squared for each number: {best.history[0]:.0f} at first, {best.loss:.2f} at the end")
assert best.loss < 1.5

# %% [markdown]
# ## What was learnt
#
# The force per length against the speed, beside the law that made the data. Below it, how often
# the nodes moved at such a speed: where there was nothing to learn from, the network only
# guesses.

# %%
tangent = jax.vmap(rx.rotations.tangent_director)(run.states.quaternion)
velocity = run.states.velocity
across = velocity - jnp.sum(velocity * tangent, 2, keepdims=True) * tangent
visited = np.linalg.norm(np.asarray(across)[1:, 1:], axis=2).ravel()
low, high = np.quantile(visited, [0.1, 0.99])
speed = np.geomspace(1e-3, 3 * high, 200)
true, found = (
    np.asarray(law.coefficient(jnp.asarray(speed))) * speed for law in (Thinning(), learnt)
)
error = np.abs(np.interp(visited, speed, found / true) - 1)
for part in (0.5, 0.9):
    print(f"at {part:.0%} of nodes and times the force is right to {np.quantile(error, part):.1%}")
assert np.quantile(error, 0.5) < 0.1

figure = Figure(figsize=(8, 5), layout="constrained")
above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
above.plot(speed, true, "k--", label="law that made the data")
above.plot(speed, found, label="network")
above.axvspan(low, high, color="0.93", zorder=0)
above.set(xscale="log", yscale="log", ylabel="drag per length [N/m]")
above.legend()
below.hist(visited, np.geomspace(speed[0], speed[-1], 60), color="0.6")
below.set(xlabel="speed across the thread [m/s]", ylabel="nodes and times")
figure

# %% [markdown]
# ## Does it predict what it has not seen?
#
# The same fluid, the thread thrown upwards at first: the law is part of any scene now.

# %%
thrown = jnp.zeros((21, 3)).at[:, 2].set(0.6 * jnp.linspace(0, 1, 21) ** 2)
tips = {
    name: np.asarray(motion(law, thrown).states.position)[1:, -1]
    for name, law in {"law that made the data": Thinning(), "network": learnt}.items()
}
off = np.linalg.norm(tips["network"] - tips["law that made the data"], axis=1).max()
print(f"the tip is predicted to {1e3 * off:.1f} mm")
assert off < 0.02

figure = Figure(figsize=(8, 3), layout="constrained")
axes = figure.subplots()
for (name, tip), style in zip(tips.items(), ("k--", "C0"), strict=True):
    axes.plot(steps, tip[:, 2], style, label=name)
axes.set(xlabel="time [s]", ylabel="height of the tip [m]")
axes.legend()
figure

# %% [markdown]
# ## What to try
#
# - Fewer pictures, or more noise: where does the network begin to follow the noise?
# - A material instead of a load: subclass `rx.AbstractMaterial` and give `moment` a network.
# - `optax.adam(0.02)` in place of L-BFGS: how many steps does it take?
# - With few parameters and a formula in mind, `rx.least_squares` tells their uncertainties as
#   well.
