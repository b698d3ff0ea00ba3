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
# # A first rod
#
# A cable of 12 m hangs from a ship into the sea, with an instrument of 6 kg at its lower end. The
# ship moves in the waves and takes the top of the cable round a circle of 1 m in 5 s. How much
# more than the weight must the top hold, and does the cable ever go slack?
#
# A dozen lines make the cable and its motion. The rest of the page looks at what they gave.

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)  # inextensibility and contact need double precision

# %% [markdown]
# ## The rod and its motion
#
# A section says how stiff, heavy and thick a rod is; `straight_rod` makes a rod of it, divided
# into elements, from `origin` along `direction`. The end $s = 0$ hangs on the ship from a pin and
# moves with it; the other is free. A lump is a mass on a node, here the last. Loads are weight
# less buoyancy, and the drag of the water on the cable and on the instrument.

# %%
section = rx.circular_section(0.02, youngs_modulus=1e8, shear_modulus=4e7, density=2500.0)
rod = rx.straight_rod(12.0, 40, section, direction=(0, 0, -1))
instrument = rx.Lump(-1, 6.0, volume=1e-3)

radius, period = 1.0, 5.0  # [m], [s]
begin = rx.Smooth([0.0, 5.0], [0.0, radius])  # the circle grows, without a jolt


def ship(time):
    angle = 2 * jnp.pi * time / period
    return begin(time) * jnp.array([jnp.cos(angle), 0.0, jnp.sin(angle)])


weight = rx.Gravity((0, 0, -9.81), fluid_density=1025.0)
water = rx.MorisonDrag(1025.0, normal_coefficient=1.2, tangential_coefficient=0.02)
drag = rx.PointDrag(node=-1, quadratic=0.5 * 1025.0 * 0.5 * 0.018)  # a ball of 15 cm, C_d = 0.5
top = rx.Pinned(displacement=rx.Function(ship))
scene = rx.Scene(rod, first_end=top, loads=(weight, water, drag), lumps=(instrument,))
run = rx.simulate(scene, 20.0, control=rx.StepControl(max_step=0.03))

# %% [markdown]
# Steps were chosen by the local error, none longer than 0.03 s, and all of them are saved. What
# one has in hand can be printed.

# %%
print(run)
print(rod)
print(scene)

# %% [markdown]
# ## To look at
#
# Drag to turn, space plays; the colours can show the tension instead. `.save("cable.html")` makes
# a file of it that any browser opens.

# %%
rx.view(scene, run, frames=100, colour="tension", title="A cable below a moving ship")

# %% [markdown]
# ## One picture
#
# The shapes in the last period, from light to dark. The ship goes round quickly beside the time
# in which the lower part can follow: the water holds it back.

# %%
figure = Figure(figsize=(5, 6.5), layout="constrained")
axes = figure.subplots()
for time in np.linspace(15.0, 20.0, 9):
    shape = np.asarray(run.nearest(time).position)
    axes.plot(shape[:, 0], shape[:, 2], color="C0", alpha=0.2 + 0.8 * (time - 15.0) / 5.0)
    axes.plot(*shape[-1, ::2], "o", color="C1", alpha=0.2 + 0.8 * (time - 15.0) / 5.0)
axes.set(xlabel="x [m]", ylabel="z [m]", xlim=(-2.5, 2.5), aspect="equal")
figure

# %% [markdown]
# ## What the top holds
#
# `reactions` is what the ends exert on the rod at one state: mapped over the states of the run,
# it gives a curve. At rest it must be the weight less the buoyancy of cable and instrument,
#
# $$ T_0 = \left[ (\rho - \rho_w) \tfrac{\pi}{4} D^2 L + m - \rho_w V \right] g . $$

# %%
hold = jax.lax.map(lambda state: rx.energy.reactions(scene, state).force[0], run.states)
along = jax.vmap(rx.rotations.tangent_director)(run.states.quaternion)[:, 0]
tension = -np.asarray(jnp.sum(hold * along, 1))
at_rest = (1475.0 * np.pi / 4 * 0.02**2 * 12.0 + 6.0 - 1025.0 * 1e-3) * 9.81
lowest, highest = tension[run.times > 5].min(), tension[run.times > 5].max()
print(f"weight in water {at_rest:.1f} N, the top holds {tension[0]:.1f} N at first")
print(f"in the waves {lowest:.1f} to {highest:.1f} N, {highest / at_rest:.2f} of the weight")
assert abs(tension[0] - at_rest) < 1e-6 * at_rest

figure = Figure(figsize=(8, 3.5), layout="constrained")
axes = figure.subplots()
axes.plot(run.times, tension, label="tension at the top")
axes.axhline(at_rest, color="0.5", ls="--", label="weight in water")
axes.axhline(0.0, color="0.8", lw=1)
axes.set(xlabel="time [s]", ylabel="[N]")
axes.legend()
figure

# %% [markdown]
# ## Where the energy went
#
# The ledger integrates every work and loss for itself; what is left over is the numerical error.
# Nearly all that the ship puts in goes to the water.

# %%
ledger = rx.energy.ledger(scene, run)
work, lost = float(ledger.work[-1]), float(ledger.drag_loss[-1])
print(f"work of the ship {work:.1f} J, lost to the water {lost:.1f} J")
print(f"energy balance error {float(ledger.balance_error):.2%} of the work")
assert ledger.balance_error < 0.01
parts = {
    "work of the ship": ledger.work,
    "lost to the water": ledger.drag_loss,
    "kinetic": ledger.kinetic,
    "potential of the weight": ledger.gravity - ledger.gravity[0],
    "bending": ledger.bending,
}
rx.plot.energies(run.times, parts)

# %% [markdown]
# ## Was it resolved?
#
# `check` looks at the finished run and says in words what it could not resolve.

# %%
print(rx.check(scene, run))

# %% [markdown]
# ## What to try
#
# - A `period` of 3 s: does the cable go slack at the top?
# - `rx.simulate(scene, 40.0, run)` goes on where this run ended.
# - Twice the elements: which of the numbers above change?
# - A current, `rx.MorisonDrag(..., current=(0.5, 0, 0))`: start from the shape at rest,
#   `rx.equilibrium(scene, rx.placing(scene))`.
