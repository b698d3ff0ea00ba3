"""The linear law as a material, for laws that add to it."""

from rodjax.rods.material import AbstractMaterial


class LinearMaterial(AbstractMaterial):
    """q = B (kappa - kappa0) with the section's stiffness: what a rod without material has.

    Example:
        >>> damped = rx.KelvinVoigt(0.01, elastic=rx.LinearMaterial())
    """

    def moment(self, at):
        return at.linear(at.bent)

    def energy(self, at):
        return 0.5 * at.bent * at.linear(at.bent)

    @property
    def viscous(self):
        return False
