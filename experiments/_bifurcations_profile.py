"""Diameters that raise the critical turns of a clamped rod at fixed mass."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from _bifurcations_scenes import RATIO, first_branch, rod_of, turned

import rodjax as rx


def find(elements: int, quick: bool, rounds: int = 20) -> dict:
    """Diameters of the same mass that raise the critical turns of a clamped rod most."""
    elements = min(elements, 64)
    rod = rod_of(elements)
    state = rx.placing(rx.Scene(rod, rx.Clamped()))
    waves = np.cos(2 * np.pi * np.arange(1, 5)[:, None] * (np.arange(elements) + 0.5) / elements)

    def scenes(amplitudes):
        """Diameters d(s), the integral of d^2 kept."""
        shape = 1.0 + amplitudes @ jnp.asarray(waves)
        fourth = (shape / jnp.sqrt(jnp.mean(shape**2))) ** 4
        own = dataclasses.replace(rod, stiffness=jnp.stack([fourth, fourth, RATIO * fourth], 1))
        return lambda turns: (turned(own), turns)

    at = jnp.zeros(len(waves))
    point = first_branch(rx.path(scenes(at), state, 0.0, 2.2, longest_step=0.4))

    @jax.jit
    def moment(amplitudes, point):
        found = rx.critical(scenes(amplitudes), point)
        scene = scenes(amplitudes)(found.parameter)[0]
        return jnp.abs(rx.energy.reactions(scene, found.state).torque[1, 2]), found

    step = jax.jit(jax.value_and_grad(moment, has_aux=True))
    history, best, reach = [], None, 0.02
    for _ in range(rounds):
        (value, found), slope = step(at, point)
        if best is None or value > best[0]:
            best, point = (value, at, slope), found
        else:
            reach *= 0.5
        history.append(float(best[0]))
        at = best[1] + reach * best[2] / jnp.linalg.norm(best[2])
    at = best[1]
    print(f"profile: critical torque {history[0]:.4f} to {history[-1]:.4f} A/L", flush=True)
    return {"torque": history, "amplitudes": at.tolist()}


def draw(axis, found: dict) -> None:
    """Critical torque against rounds."""
    axis.plot(found["torque"], "o-")
    axis.set(xlabel="round", ylabel="best critical torque [A/L]", title="profile of fixed mass")
