"""What generalised-alpha takes from a vibration: its own damping, by steps in a period."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rodjax.dynamics.run import Run
from rodjax.equations.generalized_alpha import coefficients
from rodjax.rods import lumped
from rodjax.rods.inertia import node_inertia
from rodjax.scenes.scene import Scene


def amplification(radius: float, phase: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Spectral radius of a step of x'' = -omega^2 x, by phase = omega dt [rad].

    Of (x, dt x', dt^2 a), by eliminating the acceleration from the scheme's equations; 1 without
    damping, the given radius for infinite phase.
    """
    c = coefficients(jnp.asarray(radius), jnp.asarray(1.0))
    am, af, beta, gamma = (float(v) for v in (c.alpha_m, c.alpha_f, c.beta, c.gamma))
    found = []
    for squared in np.square(np.atleast_1d(phase)):
        # (1 - am) a' + am a = -squared ((1 - af) x' + af x)
        mass = (1 - am) + squared * (1 - af) * beta
        new = -np.array([squared, squared * (1 - af), am + squared * (1 - af) * (0.5 - beta)])
        new = new / mass
        step = np.array([[1, 1, 0.5 - beta], [0, 1, 1 - gamma], [0, 0, 0]], float)
        step = step + np.outer([beta, gamma, 1.0], new)
        found.append(np.max(np.abs(np.linalg.eigvals(step))))
    return np.asarray(found)


def estimate(scene: Scene, run: Run, radius: float) -> tuple[float, float]:
    """Part of a vibration's energy that is lost over a run, and the steps in its period.

    The frequency is that of the mean of M a . a over that of M v . v (accelerations and velocities
    less their means over the run), the step the mean one.
    """
    mass, rotary = node_inertia(scene.rod)
    linear = np.repeat(np.asarray(mass)[:, None], 3, 1)
    angular = np.zeros_like(linear) if rotary is None else np.asarray(rotary)
    weight = np.concatenate([linear, angular], 1)
    if scene.rod.lumps:
        weight = weight + np.asarray(lumped.matrix_diagonal(scene.rod))

    def energy(rates):
        change = rates - np.mean(rates, 0)
        return float(np.mean(np.sum(weight * change**2, (1, 2))))

    moving = energy(np.asarray(run.states.rate))
    if moving == 0:
        return 0.0, np.inf
    squared = energy(np.asarray(run.states.acceleration)) / moving
    times, steps = np.asarray(run.times), run.infos.iterations.shape[0]
    phase = np.sqrt(squared) * (times[-1] - times[0]) / steps
    lost = 1 - float(amplification(radius, np.asarray([phase]))[0]) ** (2 * steps)
    return lost, 2 * np.pi / phase if phase > 0 else np.inf
