"""What the next step needs to know, and nothing else."""

import equinox as eqx
from jaxtyping import Array, Float


class State(eqx.Module):
    """Motion of the rod at one time.

    `rate` holds v in inertial and omega in body components, `acceleration` their derivatives,
    `auxiliary` the algorithmic acceleration of generalised-alpha, `force` the internal force f
    in the element frames.
    """

    time: Float[Array, ""]
    position: Float[Array, "n+1 3"]
    quaternion: Float[Array, "n+1 4"]
    rate: Float[Array, "n+1 6"]
    acceleration: Float[Array, "n+1 6"]
    auxiliary: Float[Array, "n+1 6"]
    force: Float[Array, "n 3"]

    @property
    def velocity(self) -> Float[Array, "n+1 3"]:
        """v in inertial components [m/s]."""
        return self.rate[..., :3]

    @property
    def angular_velocity(self) -> Float[Array, "n+1 3"]:
        """omega in body components [rad/s]."""
        return self.rate[..., 3:]
