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
# # A map of torsional buckling
#
# A steel wire is held at both ends; one is pulled with a force $T$ and turned. How many turns
# does it bear before it throws a loop, how much does the pull help, and what does it matter that
# no wire is quite straight? One run answers that for one pull and one wire. Here 64 scenes go
# through one program at once, and become a map that is laid beside the theory of the perfect
# wire.

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## One scene as a function of two numbers
#
# A wire of 1 m and 1 mm in oil. The far end slides along the wire's axis and is turned slowly, by
# six turns in a minute. Everything is a pure function of the two numbers, the pull and how far
# the crooked wire strays from the line: they change arrays of the scene alone, so one compiled
# program serves all of them. Adaptive steps cannot be mapped over; a rollout along given times
# can.

# %%
length, diameter, elements = 1.0, 1e-3, 40  # [m]
section = rx.circular_section(diameter, youngs_modulus=2e11, shear_modulus=7.7e10, density=7800.0)
rod = rx.straight_rod(length, elements, section, direction=(1, 0, 0))
A, _, C = np.asarray(rod.stiffness)[0]  # [N m^2]
times = np.linspace(0.0, 60.0, 401)  # [s]
turning = rx.PiecewiseLinearRate([0.0, 1.0, 60.0], 2 * np.pi * 6.0 / 59.5 * np.array([0, 1, 1]))
axis = jnp.array([1.0, 0.0, 0.0])
oil = rx.LinearDrag(normal=0.1, tangential=0.05, rotational=1e-6)


def scene_of(p):
    crooked = rx.imperfect(rod, fraction=p["crookedness"])
    pull = rx.PointLoad(-1, force=rx.Constant(p["tension"] * axis))
    end = rx.Slider(axis, rotation=rx.Turn(axis, turning))
    return rx.Scene(crooked, rx.Clamped(), end, loads=(oil, pull))


def outcome(p):
    """How far the end has come in at all times, and how the run ended."""
    scene = scene_of(p)
    run = rx.rollout(scene, rx.start(scene), times[1:], throw=False)
    return length - run.states.position[:, -1, 0], run.result


# %% [markdown]
# ## All of them
#
# `jax.vmap` makes of the function of one scene a function of many; `rx.jit` compiles it with the
# options that suit rods. (`rx.sweep.sweep` does the same in rounds, over devices and processes,
# and keeps the results in a file as they come.)

# %%
tensions, crookedness = np.linspace(-0.3, 1.1, 8), np.geomspace(1e-3, 3e-2, 8)
grid = np.meshgrid(tensions, crookedness)
parameters = {"tension": jnp.asarray(grid[0].ravel()), "crookedness": jnp.asarray(grid[1].ravel())}
shortening, codes = (np.asarray(x) for x in rx.jit(jax.vmap(outcome))(parameters))
for code, count in zip(*np.unique(codes, return_counts=True), strict=True):
    print(f"{count} of {len(codes)} runs: {rx.Result(int(code)).name}")

# %% [markdown]
# Most wires snap into a loop faster than these steps can follow: such a run ends there, and says
# so. That is no loss, as what is asked is *when* the end has come in by 1 %.

# %%
applied = np.array([float(turning(time)) for time in times]) / (2 * np.pi)
gone = ~(shortening < 0.01 * length)  # not a number any more: snapped
assert np.all(gone.any(1))
buckled_at = applied[gone.argmax(1)].reshape(grid[0].shape)

figure = Figure(figsize=(8, 3.5), layout="constrained")
axes = figure.subplots()
for row in range(0, 64, 8):
    axes.plot(applied, 1e3 * shortening[row + 4], label=f"{1e3 * crookedness[row // 8]:.1f}")
axes.set(xlabel="turns", ylabel="the end comes in by [mm]", ylim=(-1, 60))
axes.set_title(f"at a tension of {tensions[4]:.1f} N, by crookedness", fontsize=10)
axes.legend(fontsize=8, title="strays by [mm]")
figure

# %% [markdown]
# ## The theory of the straight wire
#
# A wire under the torque $M$ and the tension $T$ leaves the straight line when $A u'''' - i M
# u''' - T u'' = 0$ has a solution between the clamps, $u = y + i z$ the deflection. It is a sum
# of $1$, $s$ and $e^{i (b \pm c) s}$, with $b = M/2A$, $c = \sqrt{b^2 - T/A}$; that it and its
# slope vanish at both ends is a determinant of four by four. Its first root is, for $M = 0$,
# Euler's load $T = -4 \pi^2 A/L^2$, for $T = 0$ the torque $8.987\, A/L$, and for a long wire
# Greenhill's $M = 2 \sqrt{A T}$. The turns follow by $M = 2 \pi n C/L$.


# %%
def determinant(torque, tension):
    """Of the clamped wire, imaginary but for a phase that is taken off; c may be complex."""
    b = torque / (2 * A)
    c = np.emath.sqrt(b**2 - tension / A)
    p, q = b + c, b - c
    end = np.exp(1j * np.array([p, q]) * length)
    rows = [
        [1, 0, 1, 1],
        [0, 1, 1j * p, 1j * q],
        [1, length, end[0], end[1]],
        [0, 1, 1j * p * end[0], 1j * q * end[1]],
    ]
    return (np.linalg.det(np.array(rows)) * np.exp(-1j * b * length) / c).imag


def critical_turns(tension):
    """The first turns at which it vanishes."""
    least = 2 * np.sqrt(max(A * tension, 0.0)) * (1 + 1e-6) + 1e-6  # below it there are no waves
    torques = np.linspace(least, least + 14 * A / length, 4000)
    signs = np.sign([determinant(torque, tension) for torque in torques])
    return torques[np.flatnonzero(signs[1:] != signs[:-1])[0]] * length / (2 * np.pi * C)


at_zero = critical_turns(1e-9) * 2 * np.pi * C / A
print(f"without tension it buckles at a torque of {at_zero:.3f} A/L")
assert abs(at_zero - 8.9868) < 0.01
theory = np.array([critical_turns(tension) for tension in tensions])

# %% [markdown]
# ## The picture
#
# On the left the turns that each wire bore, on the right beside those of the perfect wire.

# %%
ratio = buckled_at / theory
print(
    f"the straightest wires bear {ratio[0].min():.2f} to {ratio[0].max():.2f} of the theory's turns"
)
print(f"the most crooked ones {ratio[-1].min():.2f} to {ratio[-1].max():.2f}")
assert np.all(np.abs(ratio[0] - 1) < 0.15)

figure = Figure(figsize=(10, 3.8), layout="constrained")
left, right = figure.subplots(1, 2)
colours = left.pcolormesh(tensions, crookedness, buckled_at, shading="nearest")
figure.colorbar(colours, ax=left, label="turns until it buckles")
left.set(yscale="log", xlabel="tension [N]", ylabel="crookedness: strays by [m]")
for row in range(8):
    right.plot(tensions, buckled_at[row], "o", ms=4, color=f"{0.8 * row / 7}")
right.plot(tensions, theory, "r", label="perfect clamped wire")
pulled = np.linspace(0.0, 1.1, 50)
right.plot(pulled, np.sqrt(A * pulled) / (np.pi * C) * length, "b:", label="Greenhill, long wire")
right.set(xlabel="tension [N]", ylabel="turns", title="dots: straight (black) to crooked (light)")
right.legend(fontsize=8)
figure

# %% [markdown]
# Straight wires bear what theory says, a little more as they take time to leave the line. Crooked
# ones give way earlier; the most crooked, pushed by 0.3 N, has come in by 1 % before it is
# turned. Greenhill's formula is for a long wire; with clamps and without tension a wire bears its
# share as well.
#
# ## What to try
#
# - More scenes: `rx.sweep.sweep(function, parameters, "map.h5")`, which may be stopped and goes
#   on; the function then returns a dictionary.
# - Slower turning: does the straightest row come down to the curve?
# - What comes after the snap needs contact, `rx.Contact.solid(rod, force=10.0)`, and adaptive
#   steps, `rx.simulate`, one scene at a time.
# - `experiments/sweep.py` maps first contact over three parameters, on many devices.
