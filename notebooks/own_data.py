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
# # From your own data to a rod, and back
#
# A coiled hose was measured twice with an optical tracker: lying free of load on a table, and
# held out level by one end, sagging under its weight. Does a model made of the first measurement
# predict the second? The tracker wrote tables in millimetres, with noise, and one row twice;
# results are to go on to other programs.
#
# Here the two files are made by the page itself, so that it runs anywhere; yours take their
# place.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)

folder = Path(tempfile.mkdtemp())
section = rx.circular_section(0.012, youngs_modulus=5e7, shear_modulus=1.7e7, density=1200.0)
noise = 0.3  # of the tracker [mm]

# %% [markdown]
# ## What the tracker wrote
#
# The free hose is three quarters of a turn of a helix, of 150 mm radius.

# %%
angle = np.linspace(0.0, 1.5 * np.pi, 400)
helix = np.stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), 0.02 * angle], 1)  # [m]
weight = rx.Gravity((0, 0, -9.81))
air = rx.LinearDrag(normal=0.5, tangential=0.5)  # and what the hose itself damps
real = rx.Scene(rx.curved_rod(helix, None, 80, section), rx.Clamped(), loads=(weight, air))
sagged, _ = rx.equilibrium(real, rx.placing(real))

generator = np.random.default_rng(0)


def tracked(name, points, rows):
    """A table in millimetres of noisy points, one of which is written twice."""
    picked = points[np.linspace(0, len(points) - 1, rows).astype(int)]
    table = 1e3 * picked + noise * generator.normal(size=picked.shape)
    table = np.insert(table, 20, table[20], axis=0)
    np.savetxt(folder / name, table, "%.3f", ",", header="x [mm],y [mm],z [mm]", comments="")
    return folder / name


free_file = tracked("free.csv", helix, 100)
sagging_file = tracked("sagging.csv", np.asarray(sagged.position), 81)
print("\n".join(free_file.read_text().splitlines()[:4]))

# %% [markdown]
# ## From the table to a rod
#
# `centreline` reads, looks the points through and says what it changed; what may be a fault of
# the data (a hole, points out of order, a line that turns back) it refuses until it is told what
# to do. The noise of points is curvature of a rod: 0.3 mm between points 7 mm apart. With
# `noise=` a smooth curve is laid as near to the points as the noise says.

# %%
raw = rx.centreline(free_file, factor=1e-3)
line = rx.centreline(free_file, factor=1e-3, noise=1e-3 * noise)
print(line)
rough, rod = raw.rod(80, section), line.rod(80, section)
print(rod)

true_curvature = 0.15 / (0.15**2 + 0.02**2)  # [1/m]
bends = {
    name: np.linalg.norm(np.asarray(one.natural_curvature)[:, :2], axis=1)
    for name, one in {"points as they are": rough, "smoothed": rod}.items()
}
figure = Figure(figsize=(8, 3.2), layout="constrained")
axes = figure.subplots()
for name, bend in bends.items():
    axes.plot(1e3 * np.asarray(rod.midpoints), bend, label=name)
axes.axhline(true_curvature, color="k", ls="--", label="the helix")
axes.set(xlabel="along the hose [mm]", ylabel="curvature of the free hose [1/m]")
axes.legend()
figure

# %% [markdown]
# ## Does it sag as it was measured?
#
# The rod is free of load where it was measured so (`stress_free`, the default of `curved_rod`).
# It is clamped at one end, and rests under its weight.

# %%
scene = rx.Scene(rod, rx.Clamped(), loads=(weight, air))
state, info = rx.equilibrium(scene, rx.placing(scene))
print(f"at rest after {int(info.load_steps)} steps of load; unstable modes: {int(info.unstable)}")

measured = rx.centreline(sagging_file, factor=1e-3).points
shape = np.asarray(state.position)
from_start = np.linspace(0.0, 1.0, 2001)
fine = np.stack([np.interp(from_start, np.linspace(0, 1, 81), column) for column in shape.T], 1)
apart = np.linalg.norm(measured[:, None] - fine[None], axis=2).min(1)
free = np.linalg.norm(measured[:, None] - np.asarray(line.points)[None], axis=2).min(1)
print(f"the weight moves the hose by up to {1e3 * free.max():.0f} mm")
print(
    f"measured points lie {1e3 * np.sqrt(np.mean(apart**2)):.2f} mm from the predicted line"
    f" (noise across it {noise * np.sqrt(2):.2f} mm)"
)
assert np.sqrt(np.mean(apart**2)) < 3e-3 * noise

# %%
figure = Figure(figsize=(9, 4), layout="constrained")
above, aside = figure.subplots(1, 2)
for axes, (i, j), names in ((above, (0, 1), "xy"), (aside, (0, 2), "xz")):
    axes.plot(*1e3 * np.asarray(line.points)[:, (i, j)].T, color="0.7", label="free of load")
    axes.plot(*1e3 * measured[:, (i, j)].T, "k.", ms=3, label="measured, sagging")
    axes.plot(*1e3 * shape[:, (i, j)].T, "C1", label="predicted")
    axes.set(xlabel=f"{names[0]} [mm]", ylabel=f"{names[1]} [mm]", aspect="equal")
above.legend(loc="center")
figure

# %% [markdown]
# ## How it falls
#
# The same scene has a motion: the hose let go from its free shape swings and comes to rest.

# %%
run = rx.simulate(scene, 3.0, dt=0.02)
rx.view(scene, run, frames=100, colour="curvature", title="The hose is let go")

# %% [markdown]
# ## On to other programs
#
# A table for spreadsheets and pandas, a mesh for ParaView, an `xarray` dataset with names and
# units.

# %%
table = rx.to_csv(scene, run, folder / "hose.csv")
mesh = rx.to_paraview(scene, run, folder / "hose.pvd")
print(table.read_text().splitlines()[0])
for path in sorted(folder.glob("*")):
    within = [path] if path.is_file() else list(path.iterdir())
    size = sum(one.stat().st_size for one in within) / 1e6
    print(f"{path.name}: {size:.2f} MB in {len(within)} files")

# %%
data = rx.to_xarray(scene, run)
print(data.curvature.dims, data.curvature.attrs)
figure = Figure(figsize=(8, 3.5), layout="constrained")
data.curvature.plot(ax=figure.subplots(), x="s_element", y="time")
figure

# %% [markdown]
# ## What to try
#
# - Take the duplicate out of the table, put a row far off in: what does `centreline` say?
# - `noise=None`: how far off is the prediction of the unsmoothed rod?
# - A modulus that is not known: fit it to the sagging shape by `rx.least_squares`.
# - `rx.from_pyelastica` reads motions that PyElastica computed.
