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
# # A rod shaken by heat
#
# A short piece of DNA in water is never straight: the water's molecules push it about, and it bends
# and twists as far as $k_B T$ pays for. How much is known: each bending and twist of an element is
# a variable of its own with the variance $k_B T\, \Delta s / B$, and the ends of a molecule of the
# length $L$ and the persistence length $P$ are
# $\langle R^2 \rangle = 2 P L\, (1 - P/L\, (1 - e^{-L/P}))$ apart. This page shakes one, looks
# whether it does what theory says, and how certain that is.
#
# Lengths are in nm, forces in pN, times in microseconds.

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
# ## The molecule, and what a rod in a bath must have
#
# - **Drag**, linear in the velocities, in all directions: noise is its other side. In the scene it
#   is a `LinearDrag`, of motion across the rod, along it, and of spin.
# - **A little stretch and shear.** A rigid constraint would bias the distribution. `yielding`
#   gives elements a compliance a few times stiffer than their bending, which leaves the averages
#   of bending and twist as they are.
# - **No other losses**: no viscous material, no friction.

# %%
kT, persistence, length, elements = 4.114, 50.0, 40.0, 8  # [pN nm], [nm]
A, C = persistence * kT, 2 * persistence * kT  # [pN nm^2]
spacing = length / elements
section = rx.Section(stiffness=(A, A, C), diameter=2.0)
rod = rx.yielding(rx.straight_rod(length, elements, section), 10.0)
water = rx.LinearDrag(normal=3e-3, tangential=1.5e-3, rotational=0.025)  # [pN us/nm^2, pN us]
scene = rx.Scene(rod, loads=(water,))

# %% [markdown]
# ## How long is a step, and how long a run
#
# Steps are explicit and must follow the fastest motion; a run must outlast the slowest.

# %%
times = rx.relaxation_times(scene)
slowest, fastest = times[np.isfinite(times)][0], times[-1]
dt = 0.4 * float(fastest)
steps = 5 * int(slowest / dt)  # whole numbers of looks, one in five steps
print(f"{1e3 * fastest:.3f} to {1e3 * slowest:.1f} ns: {steps} steps of {1e3 * dt:.3f} ns")

# %% [markdown]
# ## Replicas, and averages on the way
#
# A thermal state carries the key of its noise. With a key each, `vmap` makes replicas of it. What
# `measure` says of a state is averaged as the run goes on, so that no states need to be kept.


# %%
def measure(state):
    frames = state.quaternion
    turned = rx.rotations.multiply(rx.rotations.conjugate(frames[:-1]), frames[1:])
    bent = rx.rotations.logarithm(turned) / spacing  # curvatures and twist of the elements
    return {
        "curvature": jnp.mean(bent**2, 0),
        "ends": jnp.sum((state.position[-1] - state.position[0]) ** 2),
    }


@rx.jit
def shake(starts):
    def one(start):
        run = rx.thermal_rollout(
            scene, start, rx.Bath(kT), dt, steps, measure=measure, measure_every=5, throw=False
        )
        return run.final, run.averages, run.result

    return jax.vmap(one)(starts)


keys = jax.random.split(jax.random.key(1), 24)
starts = jax.vmap(lambda key: rx.thermal_start(scene, key))(keys)
starts, _, _ = shake(starts)  # into equilibrium
final, averages, results = shake(starts)
assert np.all(np.asarray(results) == rx.Result.SUCCESS)

# %% [markdown]
# ## Beside theory
#
# The averages of the replicas scatter, which tells the error of their mean. (Each replica also
# tells its own, `averages.error`, by blocks of its own past; and `averages.correlation_time` how
# many looks it remembers.) Two things are known to differ from the formulas by a percent or two at
# these long elements: angles between frames live in a curved space, $1 - \Delta s/(6 P)$, and edges
# stretch.

# %%
mean, error = averages.pooled()
expected = kT / (spacing * np.array([A, A, C])) * (1 - kT * spacing / (6 * np.array([A, A, C])))
ratio = persistence / length
wormlike = 2 * persistence * length * (1 - ratio * (1 - np.exp(-1 / ratio)))
stretched = 3 * elements * kT * float(rod.compliance[0, 0]) * spacing
for name, found, off, theory in zip(
    ("about a_1", "about a_2", "twist"),
    mean["curvature"],
    error["curvature"],
    expected,
    strict=True,
):
    print(f"{name:10} {found:.5f} +- {off:.5f} 1/nm^2, theory {theory:.5f}")
print(f"ends {mean['ends']:.0f} +- {error['ends']:.0f} nm^2, wormlike {wormlike + stretched:.0f}")
assert np.all(np.abs(np.asarray(mean["curvature"]) / expected - 1) < 0.1)
assert abs(float(mean["ends"]) / (wormlike + stretched) - 1) < 0.1

# %%
figure = Figure(figsize=(9, 3.8), layout="constrained")
left, right = figure.subplots(1, 2)
for line in np.asarray(final.state.position):
    about = line - line.mean(0)
    axes = np.linalg.svd(about, full_matrices=False)[2]
    left.plot(about @ axes[0], about @ axes[1], lw=1)
left.set(xlabel="[nm]", ylabel="[nm]", aspect="equal", title="replicas at the end")
own = np.sqrt(np.asarray(averages.variance["ends"]))
right.errorbar(
    np.arange(len(own)),
    np.asarray(averages.mean["ends"]),
    yerr=np.asarray(averages.error["ends"]),
    fmt="o",
    ms=3,
)
right.axhline(wormlike + stretched, color="0.4", ls=":", label="theory")
right.set(xlabel="replica", ylabel="mean square of the ends' distance [nm$^2$]")
right.legend(fontsize=8)
figure

# %% [markdown]
# ## A run to look at
#
# One replica with its states saved is a run as any other: `view`, `picture` and the measures take
# it.

# %%
pick = jax.tree.map(lambda leaf: leaf[0], final)
shown = rx.thermal_rollout(scene, pick, rx.Bath(kT), dt, 6000, save_every=100)
rx.view(scene, shown.run, colour="twist", title="DNA in water")

# %% [markdown]
# ## What to try
#
# - Pull it: `rx.PointLoad(0, force=rx.Constant((0, 0, -1.0)))` and the opposite at `-1`. How far
#   does it come? `experiments/tweezers.py` asks it of forces from 0.25 to 4 pN.
# - Close it to a ring, `rx.ring` with a `Weld`: how does its writhe fluctuate?
#   `experiments/minicircle.py` says.
# - Half the step, or `rx.yielding(..., 30.0)`: the averages must not move.
# - `rx.Bath(kT, implicit=True)` takes longer steps, which cost more.
