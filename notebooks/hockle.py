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
# # A hockle: how a cable on the seabed throws a loop
#
# A cable that has torsion in it is laid on the seabed and its tension is let go. It does not lie
# down straight: it rises from the bed in an arch and throws a loop, a *hockle*. Pulled straight
# again, the loop grows small, and either it pops out or the cable is kinked for good. At what
# tension does it leave the bed, and at what tension does it pop out? Here is a cable of 6 m that
# is turned three times, slackened by 2 m and pulled again, on a coarse grid;
# `experiments/hockle.py` does it for 10 m on a fine one, with friction of the strands as well.

# %%
# %matplotlib inline
import jax
import numpy as np
from matplotlib.figure import Figure

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)  # contact and inextensibility need double precision

# %% [markdown]
# ## The cable
#
# 30 mm thick, of bending stiffness $A = 15$ N m² and torsional stiffness $C = 12$ N m²; it can be
# stretched a little ($EA = 1$ MN), and loses energy inside as it is bent. `imperfect` makes it
# slightly crooked: a perfect cable would not know to which side it should buckle. It begins as
# deep in the bed as its weight presses it.

# %%
length, diameter, elements = 6.0, 0.03, 120  # [m]
A, C, EA = 15.0, 12.0, 1e6  # [N m^2], [N m^2], [N]
mass, weight = 2.0, 8.0  # [kg/m], in water [N/m]
bed_stiffness = 2e4  # [N/m^2]

inertia = mass * diameter**2 / 16
section = rx.Section(
    stiffness=(A, A, C),
    mass=mass,
    rotary_inertia=(inertia, inertia, 2 * inertia),
    compliance=(0.0, 0.0, 1 / EA),
    diameter=diameter,
    material=rx.KelvinVoigt(0.01, stretch=0.01),
)
sunk = np.sqrt(2 * 0.05 * diameter * weight / bed_stiffness)
rod = rx.straight_rod(
    length, elements, section, direction=(1, 0, 0), origin=(0, 0, diameter / 2 - sunk)
)
rod = rx.imperfect(rod, fraction=1e-3)

# %% [markdown]
# ## The story, as schedules of one end
#
# One end is clamped. The other is pulled to 100 N, turned, brought nearer by the slack, left to
# rest and pulled again. `Smooth` goes from knot to knot without a jolt.

# %%
times = np.cumsum([0.0, 1.0, 5.0, 9.0, 2.0, 12.0])  # stretched, turned, slack, rested, pulled
slack, tension = 2.0, 100.0  # [m], [N]
stretch = tension * length / EA
bed = rx.Obstacle(
    rx.Plane(),
    bed_stiffness,
    friction=rx.Friction(0.4),
    relaxation=0.4 * np.sqrt(mass / bed_stiffness),
)
water = rx.MorisonDrag(1025.0, normal_coefficient=1.2, tangential_coefficient=0.02)
gravity = rx.Gravity((0, 0, -weight / mass))  # less buoyancy
contact = rx.Contact.solid(
    rod,
    force=300.0,
    indentation=0.1,
    relaxation=1e-3,
    capacities=(64,),  # few strands touch: compile for these
)


def scene_of(turns):
    way = np.array([0.0, stretch, stretch, -slack, -slack, 2 * stretch])
    turned = 2 * np.pi * turns * np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    axis = np.array([1.0, 0.0, 0.0])
    driven = rx.Clamped(
        displacement=rx.Smooth(times, np.outer(way, axis)),
        rotation=rx.Turn(axis, rx.Smooth(times, turned)),
    )
    return rx.Scene(rod, rx.Clamped(), driven, loads=(gravity, water, bed), contact=contact)


turns, until = 3.0, 26.0  # [s], by when it has popped out
scene = scene_of(turns)
run = rx.simulate(scene, until)
print(run)
assert run.result == rx.Result.SUCCESS

# %%
rx.view(scene, run, frames=100, colour="curvature", title="A hockle")

# %% [markdown]
# ## What the driven end feels
#
# `reactions` gives force and torque of the ends; the highest node tells when the cable leaves the
# bed, the contact forces when strands touch.

# %%
on_ends = rx.jit(
    lambda scene, states: jax.lax.map(lambda state: rx.energy.reactions(scene, state), states)
)


def curves_of(scene, run):
    found = on_ends(scene, run.states)
    position = np.asarray(run.states.position)
    apart = np.linalg.norm(position[:, -1] - position[:, 0], axis=1)
    pull = np.asarray(found.force)[:, 1, 0]
    return {
        "time": np.asarray(run.times),
        "tension": pull,
        "torque": np.asarray(found.torque)[:, 1, 0],
        "height": position[:, :, 2].max(1),
        "slack": length * (1 + pull / EA) - apart,
        "strands": np.asarray(rx.measures.contacts(scene, run).total),
    }


curve = curves_of(scene, run)
figure = Figure(figsize=(9, 6), layout="constrained")
rows = figure.subplots(3, 1, sharex=True)
rows[0].plot(curve["time"], curve["tension"], label="tension")
rows[0].plot(curve["time"], curve["torque"] ** 2 / (4 * A), "--", label=r"Greenhill, $M^2/4A$")
rows[0].set(ylabel="[N]", yscale="symlog")
rows[0].legend()
rows[1].plot(curve["time"], curve["torque"])
rows[1].set(ylabel="torque [N m]")
rows[2].plot(curve["time"], curve["height"])
rows[2].set(ylabel="highest point [m]", xlabel="time [s]")
for row in rows:
    for knot, what in zip(times[:-1], ("", "turn", "slacken", "rest", "pull"), strict=True):
        row.axvline(knot, color="0.8", lw=1)
        if row is rows[0]:
            row.text(knot, 1.02, what, transform=row.get_xaxis_transform(), fontsize=8)
figure

# %% [markdown]
# It is pushed by 70 N before it rises: weight and friction hold it down while the slack comes,
# which Greenhill's formula for a free rod knows nothing of. Once up, an arch and then a loop take
# the slack with hardly any force. When the end is pulled away, the loop shrinks, the tension
# grows, and falls at once where the loop pops out.
#
# ## The shapes

# %%
moments = [6.5, 8.0, 10.0, 14.0, 20.0, 24.0, 24.6, 25.5]
figure = Figure(figsize=(10, 6.5), layout="constrained")
for column, frame in enumerate(figure.subplots(4, 2, sharex=True, sharey=True).T.ravel()):
    shape = np.asarray(run.nearest(moments[column]).position)
    frame.plot(shape[:, 0], shape[:, 1], color="C0", label="from above (y)")
    frame.plot(shape[:, 0], shape[:, 2], color="C1", label="from aside (z)")
    frame.set_title(f"t = {moments[column]:.1f} s", fontsize=9, loc="left")
    frame.set(aspect="equal", ylim=(-0.9, 1.2))
    if column == 0:
        frame.legend(fontsize=8)
figure.supxlabel("x [m]")
figure.supylabel("[m]")
figure

# %% [markdown]
# ## Beside theory
#
# Two formulas, both of long cables without weight and friction. A straight one under the torque
# $M$ is unstable below the tension (Greenhill 1883)
#
# $$ T = \frac{M^2}{4 A}, $$
#
# and a planar loop that holds the slack $d$ pops out at (Coyne 1990)
#
# $$ T = \frac{16 A}{d^2}. $$
#
# The slack is how much longer the cable is than its ends are apart. The same with four turns:
# only numbers change, so nothing is compiled anew.


# %%
def milestones(curve):
    """The last state on the bed, and the last in which strands touched."""
    on_bed = max(int(np.flatnonzero(curve["height"] > 2 * diameter)[0]) - 1, 0)
    loop = int(np.flatnonzero((curve["time"] > times[4]) & (curve["strands"] > 1.0))[-1])
    return on_bed, loop


results = {turns: curve}
other = scene_of(4.0)
results[4.0] = curves_of(other, rx.simulate(other, until))
for number, one in results.items():
    on_bed, loop = milestones(one)
    greenhill = one["torque"][on_bed] ** 2 / (4 * A)
    coyne = 16 * A / one["slack"][loop] ** 2
    print(f"{number:g} turns, {one['torque'][on_bed]:.0f} N m:")
    print(f"  leaves the bed at {one['tension'][on_bed]:.0f} N (M^2/4A = {greenhill:.0f} N)")
    print(
        f"  pops out at {one['tension'][loop]:.0f} N with a slack of {one['slack'][loop]:.2f} m"
        f" (16 A/d^2 = {coyne:.0f} N)"
    )
    assert abs(one["tension"][loop] / coyne - 1) < 0.1

# %% [markdown]
# Coyne's formula, which knows nothing of the contact, is met within a few per cent. Greenhill's
# is a bound: a cable that lies on the bed stays down longer.
#
# ## How far to trust it
#
# The loop is smallest just before it pops out. An element that turns by more than half a radian
# from one to the next does not follow the curve any more.

# %%
tangents = np.diff(np.asarray(run.states.position), axis=1)
tangents /= np.linalg.norm(tangents, axis=2, keepdims=True)
bend = np.arccos(np.clip(np.sum(tangents[:, 1:] * tangents[:, :-1], 2), -1, 1)).max()
print(f"largest bend between elements {bend:.2f} rad: a radius of {length / elements / bend:.3f} m")

# %% [markdown]
# So the smallest bend radius, by which one judges whether a real cable would have kinked, wants a
# grid about twice as fine. `rx.check(scene, run)` says so in words, and looks at much else.
#
# ## What to try
#
# - `elements = 240`: by how much do the tensions move?
# - Less slack, or two turns: an arch that lies down again, without a loop.
# - Friction of the strands: `rx.Contact.solid(..., friction=rx.SlidingFriction(0.3, 1e-3))`.
# - A cable laid of strands twists under tension: `torque_per_tension=2e-4` in the section.
