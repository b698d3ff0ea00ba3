"""Small undamped motion about an equilibrium: frequencies of vibration, growth rates, flutter."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rodjax.equations.rigid_motions import check_held
from rodjax.equations.start_checks import check_single_precision
from rodjax.equilibria.admissible import admissible, mass_matrix, rate_of, total_mass
from rodjax.equilibria.linear_stability import check_count
from rodjax.numerics.compilation import compiled
from rodjax.numerics.eigenvalues import lowest
from rodjax.rods.state import State
from rodjax.scenes.arguments import check_motion
from rodjax.scenes.scene import Scene


class Vibration(NamedTuple):
    """Modes exp(i omega t) of the linearised motion, by ascending real part of omega^2.

    `symmetric` says which problem was solved. True: K has no antisymmetric part beyond rounding,
    its symmetric part was taken, and every omega^2 is real. False: loads without potential; the
    general problem was solved, and omega^2 may be complex. Such a pair of conjugates, which stand
    side by side, is flutter: both have the same frequency and growth rate.

    Attributes:
        squared, imaginary: real and imaginary parts of omega^2 [1/s^2]; a mode of negative
            `squared` diverges.
        modes, imaginary_modes: real and imaginary parts of the displacement, inertial (3), and of
            the body spin (3) of every node, of unit modal mass.
        antisymmetry: see `Stability`.
        symmetric: which problem was solved.
    """

    squared: Float[Array, " k"]  # real part of omega^2 [1/s^2], negative for a mode that diverges
    modes: Float[Array, "k nodes 6"]  # displacement and body spin, of unit modal mass; real parts
    imaginary: Float[Array, " k"]  # imaginary part of omega^2 [1/s^2], zero but for flutter
    imaginary_modes: Float[Array, "k nodes 6"]
    antisymmetry: Float[Array, ""]  # see `linear_stability.Stability`
    symmetric: Bool[Array, ""]

    @property
    def frequency(self) -> Float[Array, " k"]:
        """Angular frequency |Re omega| of each mode [1/s]; zero for one that diverges."""
        return self._root(1)

    @property
    def growth_rate(self) -> Float[Array, " k"]:
        """Rate |Im omega| at which a mode grows as exp(sigma t) [1/s]; zero if it only vibrates."""
        return self._root(-1)

    def _root(self, sign):
        """sqrt((|z| + sign Re z) / 2) of z = omega^2, with finite derivatives."""
        real, flutters = sign * self.squared, self.imaginary != 0
        size = jnp.hypot(self.squared, jnp.where(flutters, self.imaginary, 1.0))
        x = jnp.where(flutters, 0.5 * (size + real), real)
        return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


def vibration(scene: Scene, state: State, count: int = 1) -> Vibration:
    """The `count` modes of lowest omega^2 about an equilibrium state of a scene: K x = omega^2 M x.

    K is the tangent on the motions that constraint and ends allow (see `admissible`), M the mass
    of the nodes with rotary inertia, if the rod has it, and added mass. Drag is left out. Where K
    is not symmetric (follower loads, dead end moments, drag in a current) the general problem is
    solved, of which pairs of complex omega^2 are flutter (see `Vibration`).

    Frequencies and growth rates can be differentiated (those that coincide as their mean; at the
    onset of flutter the derivative is infinite), modes cannot. Dense: cost grows as n^3, and
    round-off of omega^2 as n^2, meant for up to a few hundred elements.

    Raises:
        ValueError: the rod has no mass, its rotary inertia is too small for its precision, the ends
            leave it free to move, or `count` does not fit.

    Example:
        >>> state, _ = rx.equilibrium(scene, rx.placing(scene))
        >>> lowest = rx.vibration(scene, state, count=2).frequency  # [Hz]
    """
    check_motion(scene, state)
    if scene.rod.mass is None:
        raise ValueError("mass: a rod with mass=None does not vibrate; give its section a mass")
    check_held(scene, state)
    check_count(scene, count)
    check_single_precision(scene, moving=False)
    return _vibration(scene, state, count)


@compiled
def _vibration(scene, state, count):
    motions = admissible(scene, state)
    mass = mass_matrix(scene, state, motions)
    unit = jnp.full((), 100.0, state.position.dtype)
    found = lowest(motions.stiffness, mass, motions.ends, unit, count)
    rate = rate_of(scene)
    values = found.values * (rate * rate).astype(found.values.dtype)
    total = jnp.sqrt(total_mass(scene.rod)) * jnp.sum(scene.rod.length)
    vectors = found.vectors / total.astype(found.vectors.dtype)
    modes = lax.stop_gradient(motions.motion(scene, vectors))
    return Vibration(
        values.real,
        modes.real,
        values.imag,
        modes.imag,
        found.antisymmetry,
        found.symmetric,
    )
