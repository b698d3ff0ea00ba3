"""How the work of what acts on a rod is booked."""

import enum


class Role(enum.Enum):
    """What becomes of a load's work; see `Ledger`.

    Attributes:
        DRIVEN: work that is put in from outside, `load_work`.
        STORED: it has a potential, `gravity`; of a load that also resists motion, what it exerts
            beyond its wrench on a resting rod is `damping_loss`.
        DRAG: lost to a fluid, `drag_loss`.
        DAMPING: lost otherwise, `damping_loss`.
        CONTACT: with what the rod touches, `contact_work`: its potential is `contact_energy`, what
            it exerts beyond its wrench on a resting rod `contact_loss`.

    Example:
        >>> rx.Gravity((0, 0, -9.81)).role
        <Role.STORED: 'stored'>
    """

    DRIVEN = "driven"
    STORED = "stored"
    DRAG = "drag"
    DAMPING = "damping"
    CONTACT = "contact"
