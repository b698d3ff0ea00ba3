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
# # What does a buckling depend on?
#
# A rubber thread in water is twisted until it buckles and throws a loop. Its thickness, moduli,
# the drag of the water, the rate of turning and its crookedness all are known to some per cent
# only. Which of them decides what the thread looks like at 24 s, and which would be worth
# measuring better? A run for each would answer it one by one; derivatives through the run answer
# it for all of them, and for all times, at once.

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
# ## A motion as a function of its inputs
#
# All inputs are factors on what is assumed, so that derivatives by them are comparable: $p\,
# \partial W / \partial p$ is what 100 % more of $p$ would do, to first order. What is measured is
# the writhe $W$, the turns that the line itself makes about itself: 0 of a straight thread, about
# 1 of a loop.

# %%
length, elements = 1.0, 50  # [m]
times = np.linspace(0.0, 26.0, 174)  # [s]
axis = (0.0, 1.0, 0.0)


def scene_of(p):
    section = rx.circular_section(
        3.14e-4 * p["diameter"],
        youngs_modulus=1.25e7 * p["Young's modulus"],
        shear_modulus=5e6 * p["shear modulus"],
        density=1500.0 * p["density"],
    )
    rod = rx.straight_rod(length, elements, section, direction=axis)
    rod = rx.imperfect(rod, fraction=2e-3 * p["crookedness"])
    turns = 2 * jnp.pi * p["turns"] * jnp.array([0.0, 4.4, 5.2])
    turned = rx.Clamped(
        rotation=rx.Turn(axis, rx.PiecewiseLinear(jnp.array([0.0, 15.0, 30.0]), -turns))
    )
    water = rx.MorisonDrag(1000.0, 0.1 * p["drag"], 0.01 * p["drag"])
    return rx.Scene(rod, turned, rx.Slider(axis), loads=(water,))


def moved(p):
    scene = scene_of(p)
    return rx.rollout(scene, rx.start(scene), times[1:], throw=False)


def writhe(p):
    return rx.measures.linking(scene_of(p), moved(p)).writhe


inputs = ["diameter", "Young's modulus", "shear modulus", "density", "drag", "turns", "crookedness"]
assumed = dict.fromkeys(inputs, 1.0)
motion = rx.jit(moved)
scene, run = scene_of(assumed), motion(assumed)
assert run.result == rx.Result.SUCCESS
link = rx.measures.linking(scene, run)
assert np.max(np.abs(link.error)) < 1e-6  # no strand has passed through another
at = int(np.argmin(np.abs(times - 24.0)))
print(f"writhe at {times[at]:.1f} s: {float(link.writhe[at]):.3f} turns")
rx.plot.topology(run.times, link.twist, link.writhe, link.turns)

# %%
rx.view(scene, run, frames=100, title="A twisted thread")

# %% [markdown]
# ## All derivatives at once
#
# Forward mode: few inputs and many results. Each step is differentiated by the implicit function
# theorem, one linear solve with the matrix that Newton's method has ended on, so what comes out
# is the derivative of the discrete motion, exact to rounding.

# %%
slopes = rx.jit(jax.jacfwd(writhe))(assumed)
slopes = {name: np.asarray(slopes[name]) for name in inputs}

figure = Figure(figsize=(9, 4), layout="constrained")
axes = figure.subplots()
for name in inputs:
    axes.plot(times, slopes[name], label=name)
axes.plot(times, link.writhe, "k--", label="the writhe itself")
axes.set(xlabel="time [s]", ylabel=r"$p\,\partial W/\partial p$ [turns]", xlim=(12, 26))
axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
figure

# %% [markdown]
# Nothing matters until the thread buckles. From then on everything does, and most inputs by more
# than the writhe itself: they decide *when* it buckles.
#
# ## Is it right?
#
# A difference of two runs, all inputs changed at once by as much in a random direction, must be
# what the derivatives say.

# %%
direction = dict(zip(inputs, np.random.default_rng(0).normal(size=len(inputs)), strict=True))
step = 1e-4
ends = []
for sign in (1, -1):
    changed = {name: 1.0 + sign * step * direction[name] for name in inputs}
    ends.append(rx.measures.linking(scene_of(changed), motion(changed)).writhe)
difference = np.asarray(ends[0] - ends[1]) / (2 * step)
predicted = sum(direction[name] * slopes[name] for name in inputs)
error = np.max(np.abs(difference - predicted)) / np.max(np.abs(predicted))
print(f"derivatives and differences agree to {error:.1e}")
assert error < 1e-3

# %% [markdown]
# ## What is worth measuring better?
#
# An input matters by its derivative times how badly it is known. With these uncertainties, taken
# as independent and small:

# %%
known_to = {
    "diameter": 0.01,
    "Young's modulus": 0.05,
    "shear modulus": 0.05,
    "density": 0.01,
    "drag": 0.3,
    "turns": 0.002,
    "crookedness": 0.5,
}
shares = {name: slopes[name][at] * known_to[name] for name in inputs}
total = np.sqrt(sum(share**2 for share in shares.values()))
print(f"writhe at {times[at]:.1f} s: {float(link.writhe[at]):.3f} +- {total:.3f} turns")
assert np.argmax(np.abs([shares[name] for name in inputs])) == inputs.index("shear modulus")
for name, share in sorted(shares.items(), key=lambda pair: -abs(pair[1])):
    print(f"  {name}: {share:+.4f} turns for {known_to[name]:.1%}")

figure = Figure(figsize=(9, 3.5), layout="constrained")
left, right = figure.subplots(1, 2, sharey=True)
left.barh(inputs, [slopes[name][at] for name in inputs], color="C0")
left.set(xlabel=r"$p\,\partial W/\partial p$ [turns]", title="by the same part of each")
right.barh(inputs, [shares[name] for name in inputs], color="C1")
right.set(xlabel="turns", title="by what is not known of each")
for axes in (left, right):
    axes.axvline(0, color="k", lw=0.8)
figure

# %% [markdown]
# The two moduli decide, in opposite directions; the turns, which have the largest derivative, are
# known too well to matter.
#
# ## What to try
#
# - The derivative of *when* it buckles: `rx.measures.first_crossing` of the writhe.
# - Many inputs and one result: `jax.grad` instead of `jax.jacfwd`, for instance by the diameter
#   of every element.
# - How far do linear shares reach? Change a modulus by 10 % and run again.
# - Into contact: `experiments/gradient_check.py` does it through the collapse.
