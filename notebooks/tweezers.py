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
# # DNA in magnetic tweezers, at zero temperature
#
# A DNA molecule is fixed to a surface by one end and to a magnetic bead by the other. A magnet
# pulls the bead with a constant force and turns it. What is measured is how the extension falls
# as turns are put in: hardly at first, until the molecule buckles and winds up on itself. How
# many turns does that take, what torque is left then, and how much shorter does each further turn
# make the molecule? Here the molecule is an elastic rod without thermal noise; the end says what
# noise would change.
#
# Lengths are in nm, forces in pN, times in s: energies then are in pN nm, and $k_B T = 4.11$ pN
# nm.

# %%
# %matplotlib inline
import dataclasses

import jax
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)  # contact and inextensibility need double precision
names = rx.units.use(rx.units.Units("nm", "s", "pN s^2/nm", "pN"))  # what pictures say

# %% [markdown]
# ## The molecule
#
# 300 nm long (880 base pairs), with a bending persistence length of 50 nm and a torsional one of
# 100 nm: $A = 50$ nm $k_B T$, $C = 100$ nm $k_B T$. The strands repel each other by their
# charges; in salt of about 100 mM that is nearly a solid of 5 nm. There is no inertia at this
# scale: a rod with `mass=None` rests on the drag of the water, and the bead has a drag of its
# own.

# %%
kT, viscosity = 4.11, 1e-9  # [pN nm], [pN s/nm^2]
A, C = 50 * kT, 100 * kT  # [pN nm^2]
length, diameter, elements = 300.0, 5.0, 100  # [nm]
force = 2.0  # [pN]

section = rx.Section(stiffness=(A, A, C), mass=None, diameter=diameter)
rod = rx.straight_rod(length, elements, section, direction=(0, 0, 1))
rod = rx.imperfect(rod, fraction=1e-3)  # a perfect rod would never choose a side
water = rx.LinearDrag(
    normal=2 * 2 * np.pi * viscosity,
    tangential=2 * np.pi * viscosity,
    rotational=np.pi * viscosity * 2.0**2,
)
bead = rx.PointDrag(node=-1, linear=6 * np.pi * viscosity * 500.0)  # of a radius of 500 nm
pull = rx.PointLoad(-1, force=rx.Constant((0.0, 0.0, force)))
contact = rx.Contact.solid(rod, force=10.0, indentation=0.1)
contact = dataclasses.replace(contact, capacities=(contact.segments + 1,))  # of one size

# %% [markdown]
# ## The bead
#
# The bead moves along the axis as it will (`Slider`), and is turned by the magnet, slowly beside
# anything that the molecule does.

# %%
most, seconds = 6.5, 4.0
magnet = rx.PiecewiseLinear([0.0, seconds], [0.0, 2 * np.pi * most])
up = (0.0, 0.0, 1.0)
scene = rx.Scene(
    rod,
    first_end=rx.Clamped(),
    last_end=rx.Slider(up, rotation=rx.Turn(up, magnet)),
    loads=(water, bead, pull),
    contact=contact,
)
control = rx.StepControl(relative=0.3, absolute=0.05, twisting=0.2)
run = rx.simulate(scene, seconds, control=control)
print(run)
assert run.result == rx.Result.SUCCESS

# %%
rx.view(scene, run, frames=100, colour="twist", title="DNA in tweezers")

# %% [markdown]
# ## Extension and torque against turns
#
# The torque is that by which the magnet must hold the bead.

# %%
on_ends = rx.jit(
    lambda scene, states: jax.lax.map(lambda s: rx.energy.reactions(scene, s).torque[1, 2], states)
)
torque = np.asarray(on_ends(scene, run.states))  # [pN nm]
link = rx.measures.linking(scene, run)
turns, extension = np.asarray(link.turns), np.asarray(run.states.position)[:, -1, 2]
assert np.max(np.abs(link.error)) < 1e-6  # no strand has passed through another

# %% [markdown]
# ## Beside theory
#
# **Where it buckles.** A straight rod that is infinitely long is unstable beyond Greenhill's
# torque
#
# $$ M_G = 2 \sqrt{A F} . $$
#
# With clamped ends a finite length adds a little. At this torque nothing else is stable near by:
# what follows is a jump, through a loop, to a plectoneme. (Localised buckles exist below $M_G$
# already, as solitary bends; a rod that is not disturbed does not reach them.)
#
# **What torque is left.** In the plectoneme two strands of radius $R$ wind about each other at an
# angle $\alpha$. To make it longer by a bit costs work against the pull and bending, and gains
# what the torque gives; balance of all three, for strands in hard contact, is (Clauvelin, Audoly
# & Neukirch 2009)
#
# $$ F = \frac{A}{R^2} \sin^4\alpha \left( \frac{1}{2} + \frac{1}{\cos 2\alpha} \right) , \qquad
# M = \frac{2 A}{R}\, \frac{\cos\alpha \sin^3\alpha}{\cos 2\alpha} , $$
#
# the first of which gives the angle, the second the torque, whatever the turns: a plateau. Each
# further turn is taken up by a length $4 \pi R / \sin 2\alpha$ of the molecule.

# %%
greenhill = 2 * np.sqrt(A * force)
radius = 0.5 * diameter
jump = turns[np.argmax(torque)]
buckled = turns > jump + 0.3


def missing(angle):
    return A / radius**2 * np.sin(angle) ** 4 * (0.5 + 1 / np.cos(2 * angle)) - force


angle = brentq(missing, 0.01, 0.7)
plateau = 2 * A / radius * np.cos(angle) * np.sin(angle) ** 3 / np.cos(2 * angle)
per_turn = 4 * np.pi * radius / np.sin(2 * angle)

found_plateau = np.mean(torque[buckled])
found_per_turn = -np.polyfit(turns[buckled], extension[buckled], 1)[0]
print(f"largest torque {torque.max():.1f} pN nm; 2 sqrt(A F) = {greenhill:.1f} pN nm")
print(f"plateau {found_plateau:.1f} pN nm; theory {plateau:.1f} at {np.degrees(angle):.1f} degrees")
print(f"shortening {found_per_turn:.1f} nm a turn; theory {per_turn:.1f} nm")
assert abs(torque.max() / greenhill - 1) < 0.05
assert abs(found_plateau / plateau - 1) < 0.1
assert abs(found_per_turn / per_turn - 1) < 0.1

figure = Figure(figsize=(9, 3.8), layout="constrained")
left, right = figure.subplots(1, 2)
left.plot(turns, extension)
right.plot(turns, torque)
right.axhline(greenhill, color="0.4", ls=":", label=r"$2\sqrt{AF}$")
right.axhline(plateau, color="0.7", ls=":", label="theory of the plectoneme")
left.set(xlabel="turns", ylabel="extension [nm]")
right.set(xlabel="turns", ylabel="torque [pN nm]")
right.legend(fontsize=8)
figure

# %% [markdown]
# The molecule stays straight up to Greenhill's torque, then jumps: at once most of the twist
# becomes writhe. From there the torque stays, and each turn takes its length. Plateau and slope
# are both those of strands 6 % thicker: contact acts between chords of its segments, which hold
# strands that wind about each other a little farther apart, and make the ripple as they pass.
#
# ## What thermal noise would change
#
# - **The extension of the straight part.** It is not 1: undulations take $k_B T / \sqrt{4 A F}$ of
#   it (Marko & Siggia 1995), here 10 %, and take up writhe, so that the torsional stiffness that is
#   seen at low force is less than $C$ (Moroz & Nelson 1997).
# - **The jump.** Noise lets a loop form before the straight state becomes unstable: the molecule
#   hops between straight and buckled where both have the same free energy. The torque never
#   reaches $2 \sqrt{A F}$.
# - **The plectoneme.** Confining the undulations of its strands costs entropy, which pushes them
#   apart: it is looser, and its torque higher than that of strands in contact.
#
# So forces and slopes of this page are those of a cold rod. Buckling at Greenhill's torque is not
# what a measurement shows; a plateau and a linear fall of the extension are.
#
# ## What to try
#
# - `force = 1.0`: how do buckling, plateau and slope move? Theory says by $\sqrt F$ at first.
# - Unwind it again: the last loop stays until fewer turns than it needed to form, a hysteresis.
# - Shorter chords: `rx.Contact.solid(..., segments=2 * contact.segments)`.
# - Charges instead of solids: `rx.Contact(rx.DebyeHueckel(strength, screening), ...)`, with the
#   strength $k_B T\, l_B \nu^2$ and the Debye length of your salt.
# - `experiments/plectoneme.py` winds a dense plectoneme up against the full theory of the ply.
