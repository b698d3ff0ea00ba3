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
# # Where does a twisted rod buckle to?
#
# A rod is clamped at one end and turned at the other, which may slide along the axis. It stays
# straight, stays straight, and then throws a loop. A simulation shows the jump; it does not show
# what the rod jumps away from, nor how far back the turns must go before the loop comes out again.
# Both are told by the equilibria, stable or not. They are followed here from straight to loop, and
# then the rod is given the profile that holds out longest.

# %%
# %matplotlib inline
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The rod, straight
#
# Bending stiffness 1, torsional stiffness 0.8, length 1: torques are in $A/L$. `path` takes the
# scene's own schedules, and their time as the parameter, which here is turns.

# %%
elements, ratio, axis = 24, 0.8, (0.0, 0.0, 1.0)
section = rx.Section((1.0, 1.0, ratio), diameter=0.02, mass=1.0)
rod = rx.straight_rod(1.0, elements, section)
turn = rx.Turn(axis, rx.PiecewiseLinear([-9.0, 9.0], [-18 * np.pi, 18 * np.pi]))
scene = rx.Scene(rod, rx.Clamped(), rx.Slider(axis, rotation=turn))


def shortening(scene, state):
    return 1.0 - state.position[-1, 2]


def torque(scene, state):
    return rx.energy.reactions(scene, state).torque[1, 2]


units = {"shortening": "L", "torque": "A/L"}
measures = {"shortening": shortening, "torque": torque}
straight = rx.path(scene, rx.placing(scene), 0.0, 2.2, measures=measures)
print(straight)
first = straight.critical[0]
threshold = 2 * np.pi * ratio * float(first.parameter)
print(
    f"it buckles at a torque of {threshold:.3f} A/L; theory, tan x = x with x = M L/2A, has 8.987"
)
assert abs(threshold / 8.986819 - 1) < 2e-3

# %% [markdown]
# ## What leaves there
#
# The rod is alike in all directions, so two modes lose their stability at once: they are one
# buckle, turned about the axis. `branch` follows it.

# %%
buckled = rx.branch(scene, first, (1.0, 2.2), measures=measures)
print(buckled)
assert buckled.unstable[1] == 1 and buckled.parameters[-1] < float(first.parameter)

figure = Figure((9, 3.4), layout="constrained")
for axes, name in zip(figure.subplots(1, 2), measures, strict=True):
    for path, label in ((straight, "straight"), (buckled, "buckled")):
        values, unstable = np.asarray(path.measures[name]), path.unstable > 0
        (line,) = axes.plot(path.parameters, np.where(unstable, np.nan, values), label=label)
        axes.plot(path.parameters, np.where(unstable, values, np.nan), "--", color=line.get_color())
    axes.plot(float(first.parameter), {"shortening": 0, "torque": threshold}[name], "ko", ms=4)
    axes.set(xlabel="turns", ylabel=f"{name} [{units[name]}]")
    axes.legend()
figure

# %% [markdown]
# The buckled states lie at *fewer* turns than the straight ones, and are unstable (dashed): the
# rod has nothing near by to go to, and jumps. They are what it must be pushed across to jump
# before: the nearer to the threshold, the smaller the push. In shape they are a helix that becomes
# a loop:

# %%
picture = Figure((8, 2.6), layout="constrained")
panels = picture.subplots(1, 3, subplot_kw={"projection": "3d"})
for axes, i in zip(panels, (2, len(buckled) // 2, -1), strict=True):
    x, y, z = np.asarray(buckled.states.position[i]).T
    axes.plot(z, x, y, "k-")
    axes.set(title=f"{buckled.parameters[i]:.2f} turns", aspect="equal")
    axes.set_axis_off()
picture

# %% [markdown]
# ## Which profile holds out longest?
#
# `critical` gives the branch point of another rod as a differentiable function of that rod. The
# diameter varies along the rod by four cosines, at the same mass, and steps uphill along the
# gradient of the critical torque make the rod thicker where that pays.

# %%
s = (np.arange(elements) + 0.5) / elements
waves = jnp.asarray(np.cos(2 * np.pi * np.arange(1, 5)[:, None] * s))


def profile(amplitudes):
    shape = 1.0 + amplitudes @ waves
    return shape / jnp.sqrt(jnp.mean(shape**2))


def critical_torque(amplitudes, near):
    fourth = profile(amplitudes) ** 4
    stiffness = jnp.stack([fourth, fourth, ratio * fourth], 1)
    other = dataclasses.replace(scene, rod=dataclasses.replace(rod, stiffness=stiffness))
    found = rx.critical(other, near)
    moment = 2 * jnp.pi * found.parameter / jnp.mean(1.0 / stiffness[:, 2])
    return moment, found


uphill = rx.jit(jax.value_and_grad(critical_torque, has_aux=True))
amplitudes, near, torques = jnp.zeros(4), first, []
for _ in range(12):
    (value, near), slope = uphill(amplitudes, near)
    torques.append(float(value))
    amplitudes = amplitudes + 0.02 * slope / jnp.linalg.norm(slope)
print(f"critical torque {torques[0]:.3f} to {torques[-1]:.3f} A/L at the same mass")
assert torques[-1] > 1.02 * torques[0]

sketch = Figure((8, 2.6), layout="constrained")
left, right = sketch.subplots(1, 2)
left.plot(torques, "o-")
left.set(xlabel="step", ylabel="critical torque [A/L]")
right.plot(s, profile(amplitudes))
right.set(xlabel="s [L]", ylabel="diameter, 1 if even", ylim=(0, None))
sketch

# %% [markdown]
# ## What to try
#
# - Pull with a force (`rx.PointLoad`), and the buckle localises: compare its shortening with
#   Coyne's $4\sqrt{A/T}\sqrt{1 - M^2/4AT}$.
# - Give the rod a natural curvature: the branch point becomes a fold. How does its number of turns
#   fall with the curvature?
# - Give the scene a `Contact`, and follow the loop on: `experiments/example_path.py` does.
