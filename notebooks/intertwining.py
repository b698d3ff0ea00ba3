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
# # From a straight rod to intertwined loops
#
# A rod is twisted slowly at one end while the other end may slide towards it. It stays straight
# at first, buckles into a shallow helix, forms a loop, and the loop collapses upon itself and
# intertwines. This is the illustrative example of Goyal, Perkins & Lee, *Non-linear dynamic
# intertwining of rods with self-contact* (section 4). Here it is built step by step, on a coarse
# grid; `experiments/intertwine.py` runs it on a fine one.
#
# The paper's text leaves three inputs open: the diameter (its Fig. 5), the twist rate (Fig. 6)
# and the imperfection that starts buckling. Those used here are **assumed**: they make the times
# of the paper's milestones come out.

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np

import rodjax

kept = rodjax.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)  # contact and inextensibility need double precision

# %% [markdown]
# ## The rod
#
# One metre long, of circular section, with the moduli and the density of the paper's Table 1. The
# middle quarter is necked to 0.9 of the diameter; `jumps` puts nodes where the diameter jumps, so
# that no element straddles a jump. The rod lies along the inertial axis $e_2$, its end $s = 0$ at
# the origin. By default it can neither stretch nor shear (Kirchhoff's rod).

# %%
from rodjax import circular_section, straight_rod

diameter = 3.14e-4  # [m], assumed
seed = 0.05  # natural curvature about a_1 [1/m], assumed
axis = (0.0, 1.0, 0.0)  # the loading axis e2


def diameter_at(s):
    return np.where((s > 0.375) & (s < 0.625), 0.9 * diameter, diameter)


section = circular_section(diameter_at, youngs_modulus=1.25e7, shear_modulus=5e6, density=1500.0)
rod = straight_rod(
    1.0,
    60,
    section,
    direction=axis,
    natural_curvature=(seed, 0.0, 0.0),
    jumps=(0.375, 0.625),
)
print(
    f"{rod.elements} elements, A = {rod.stiffness[0, 0]:.3g} N m^2, C = {rod.stiffness[0, 2]:.3g}"
)

# %% [markdown]
# ## The ends
#
# The right end, $s = 0$, is turned about $e_2$: 4 turns in the first 14.2 s, then 0.023 turns a
# second (assumed). Turned by *minus* these turns, it gives a positive linking number. The left end
# slides along $e_2$ and is held from 30 s on.

# %%
from rodjax import Clamped, PiecewiseLinear, Slider, Switched, Turn

turns = PiecewiseLinear([0.0, 14.2, 114.2], -2 * np.pi * np.array([0.0, 4.0, 6.3]))
right_end = Clamped(rotation=Turn(axis, turns))
left_end = Switched(Slider(axis), Clamped(), 30.0)

# %% [markdown]
# ## Loads and self-contact
#
# The only load is the drag of the surrounding water, Eq. (14) of the paper. Self-contact is its
# Eq. (13), with the coefficients of its Table 1. How far strands feel each other and the screening
# aperture (120 degrees) are assumed; segments are short enough for a smooth force.

# %%
from rodjax import Contact, DampedInversePower, MorisonDrag

drag = MorisonDrag(fluid_density=1000.0, normal_coefficient=0.1, tangential_coefficient=0.01)
law = DampedInversePower(k1=1e-7, k2=3.0, k3=1e-6, k4=1.0, reference_spacing=1e-3)
contact = Contact(law, segments=200, cutoff=15e-3, aperture=2 * np.pi / 3)

# %% [markdown]
# ## The scene and its motion
#
# A scene puts these together. `simulate` makes velocities, accelerations and forces at the start
# consistent with the constraints and chooses the steps by the local error. The first call compiles
# the step, which takes longer than the run. Ctrl-C (or the notebook's stop button) returns what
# there is by then.

# %%
from rodjax import Scene, StepControl, simulate

scene = Scene(rod, right_end, left_end, loads=(drag,), contact=contact)
end_time = 26.0 if contact is None else 32.0  # strands would pass through each other without it
run = simulate(scene, end_time, control=StepControl(max_step=0.36))
print(f"{len(run.times) - 1} steps to {run.times[-1]:g} s")

# %% [markdown]
# ## To look at
#
# Drag to turn, play, choose what the colours mean. `.save("run.html")` makes a file of it.

# %%
from rodjax import view

view(scene, run, title="A twisted rod loops and intertwines")

# %% [markdown]
# ## Shapes
#
# The tubes are coloured by strain-energy density, Eq. (4), and drawn thicker than they are. The
# black stripe on the first follows one line of the surface and shows the twist.

# %%
from rodjax import energy, plot

states = [run.nearest(time) for time in (20.0, 25.0, 29.0, 32.0) if time <= end_time]
density = [energy.strain_energy_density(rod, state) for state in states]
plot.snapshots(rod, states, density, magnify=20, title=f"D = {1e3 * diameter:g} mm (assumed)")

# %% [markdown]
# ## Twist becomes writhe
#
# Twist Tw is the turning of the rod about its axis, writhe Wr the coiling of the axis. As long as
# no strand passes through another, their sum Lk is the number of turns applied at the end.

# %%
from rodjax import measures

linking = measures.linking(scene, run)
error = float(jnp.max(jnp.abs(linking.error)))
assert error < 1e-6
print(f"|Tw + Wr - turns| is at most {error:.1e}")
plot.topology(run.times, linking.twist, linking.writhe, linking.turns)

# %% [markdown]
# ## Torsional energy becomes bending energy
#
# The ledger integrates every work and loss for itself; what is left over is the numerical error.

# %%
ledger = energy.ledger(scene, run)
buckling = float(measures.time_of_maximum(run.times, ledger.torsion))
print(f"torsional energy is largest at {buckling:.1f} s (paper: 16-18 s)")
print(f"energy balance error: {float(ledger.balance_error):.2%} of the work")
parts = {
    "bending": ledger.bending,
    "torsion": ledger.torsion,
    "total strain": ledger.strain,
    "work of the drive": ledger.work,
    "lost to drag": ledger.drag_loss,
}
plot.energies(run.times, parts, marks={"buckling": buckling})

# %% [markdown]
# ## What to try
#
# - `python experiments/intertwine.py` runs this on 200 elements to 36 s and stores everything.
# - Change `diameter`, the schedule of `turns` or `seed`: how do the times move?
# - `--no-contact` shows what happens when strands may pass: Tw + Wr drops by 2 at each passage.
