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
# # Fitting what cannot be measured directly
#
# A rubber hose is clamped at one end, 0.25 m above a bed of soft mud, and let go in water. It
# falls, sinks into the mud and comes to rest. A camera sees five markers on it. From these points
# alone: what are the drag of the water, and the stiffness and damping of the mud, how certain are
# they, and is the model right at all?
#
# The data are made here, with numbers that are known, so that the answer can be judged.

# %%
# %matplotlib inline
import jax
import numpy as np
from matplotlib.figure import Figure
from scipy import optimize

import rodjax as rx

rx.keep_compiled()  # programs, for the next time that this notebook runs
jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The model
#
# `predict` makes what the camera would see from a set of parameters: a scene, its motion along
# given steps, and the positions of every fourth node at the times of the pictures. Derivatives go
# through all of it. The bed pushes with $k\, (d + \tau \dot d)$ per length, $d$ the depth.

# %%
section = rx.circular_section(0.02, youngs_modulus=1e6, shear_modulus=3.4e5, density=1500.0)
rod = rx.straight_rod(1.0, 20, section, direction=(1, 0, 0), origin=(0, 0, 0.25))
weight = rx.Gravity((0, 0, -9.81), fluid_density=1000.0)
steps = np.linspace(0.0, 3.0, 121)[1:]  # [s]
pictures = np.linspace(0.2, 3.0, 15)  # [s]


def scene_of(p):
    water = rx.MorisonDrag(1000.0, p["drag"], 0.02)
    mud = rx.Obstacle(rx.Plane(), p["stiffness"], softness=0.2, relaxation=p["damping"])
    return rx.Scene(rod, rx.Clamped(), loads=(weight, water, mud))


def moved(p):
    scene = scene_of(p)
    return rx.rollout(scene, rx.start(scene), steps, throw=False)


def predict(p):
    return rx.positions_at(moved(p), pictures)[:, 4::4]


truth = {"drag": 1.1, "stiffness": 150.0, "damping": 0.1}  # [-], [N/m^2], [s]
noise = 2e-3  # [m]
seen = rx.jit(moved)
run = seen(truth)
exact = np.asarray(rx.positions_at(run, pictures)[:, 4::4])
data = exact + noise * np.random.default_rng(0).normal(size=exact.shape)
print(f"{data.shape[0]} pictures of {data.shape[1]} markers, each known to {1e3 * noise:g} mm")

# %%
rx.view(scene_of(truth), run, frames=100, title="A hose falls into mud")

# %% [markdown]
# ## The fit
#
# `least_squares` begins with numbers that are wrong by factors of 2 to 5. `Positive` lets it
# search in the logarithms.

# %%
observed = rx.Observations(pictures, data, deviation=noise)
guess = {"drag": 2.5, "stiffness": 700.0, "damping": 0.03}
fit = rx.least_squares(predict, guess, observed, bounds=rx.Positive(), tolerance=1e-5)
print(fit)
off = {k: (float(fit.parameters[k]) - truth[k]) / float(fit.deviations[k]) for k in truth}
print("off by", ", ".join(f"{v:+.1f} deviations ({k})" for k, v in off.items()))
assert fit.result == rx.FitResult.CONVERGED
assert all(abs(value) < 4 for value in off.values())
assert 0.7 < fit.reduced < 1.3

# %% [markdown]
# Chi squared for each degree of freedom is near one: the model explains the data to their noise.
#
# ## How certain, and what goes with what
#
# The covariance says more than the deviations: where a cloud is tilted, one number can to some
# degree stand for the other. Here the data tell the three well apart. The clouds are what a
# hundred repetitions of the experiment would give, by the linear theory.

# %%
spread = np.sqrt(np.diag(fit.covariance))
correlation = fit.covariance / np.outer(spread, spread)
print("correlations of", ", ".join(fit.names))
print(np.array2string(correlation, precision=2, suppress_small=True))

best = np.array([float(fit.parameters[name]) for name in fit.names])
cloud = np.random.default_rng(1).multivariate_normal(best, fit.covariance, 100)
units = {"drag": "drag coefficient", "stiffness": "stiffness [N/m²]", "damping": "damping [s]"}
figure = Figure(figsize=(9, 3.2), layout="constrained")
for axes, (i, j) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
    axes.plot(cloud[:, i], cloud[:, j], ".", color="0.6")
    axes.plot(best[i], best[j], "o", label="fitted")
    axes.plot(truth[fit.names[i]], truth[fit.names[j]], "k+", ms=12, label="true")
    axes.set(xlabel=units[fit.names[i]], ylabel=units[fit.names[j]])
axes.legend()
figure

# %% [markdown]
# ## Looking at what is left
#
# A fit that converged is not yet a right one. What is left over should be noise: without a trend
# in time or along the hose. Beside it stands the same fit by a model with hardly any damping in
# the mud, which a person might have tried first. (It is made by scipy's optimizer from the same
# function, by differences: any will do where there are two numbers.)

# %%


def left_over(logarithms):
    drag, stiffness = np.exp(logarithms)
    run = seen({"drag": drag, "stiffness": stiffness, "damping": 0.01})
    found = (np.asarray(rx.positions_at(run, pictures)[:, 4::4]) - data).ravel() / noise
    return np.nan_to_num(found, nan=1e3)  # a trial that fails is far off


wrong = optimize.least_squares(left_over, np.log(best[[1, 2]]), diff_step=1e-4)
drag, stiffness = np.exp(wrong.x)
reduced = 2 * wrong.cost / (data.size - 2)
print(f"with little damping: drag {drag:.3f}, stiffness {stiffness:.0f} N/m², ", end="")
print(f"reduced chi squared {reduced:.2f} beside {fit.reduced:.2f}")
assert wrong.success
assert reduced > 1.3

figure = Figure(figsize=(9, 4), layout="constrained")
panels = figure.subplots(1, 2, sharey=True)
residuals = {
    "with damping": fit.residuals,
    "with a tenth of the damping": noise * wrong.fun.reshape(data.shape),
}
for axes, (title, of_fit) in zip(panels, residuals.items(), strict=True):
    for marker in range(data.shape[1]):
        label = f"marker {marker + 1}"
        axes.plot(pictures, 1e3 * of_fit[:, marker, 2], "o-", ms=3, lw=0.8, label=label)
    axes.axhspan(-2e3 * noise, 2e3 * noise, color="0.92", zorder=0)
    axes.set(xlabel="time [s]", title=title)
panels[1].legend(fontsize=8)
panels[0].set(ylabel="predicted less seen height [mm]")
figure

# %% [markdown]
# (Grey: twice the noise.) With little damping the two others are made to account for it, and the
# drag comes out wrong by several of its deviations. The optimizer is as content as before; only
# the residuals tell.
#
# ## What to try
#
# - Let the modulus be fitted too: is it determined? `fit.undetermined` says which combination is
#   not.
# - Only the first second of the pictures: what becomes of the stiffness?
# - `rx.several_starts` begins from many guesses at once.
# - `experiments/fit_contact_law.py` fits the law between the strands of a plectoneme.
