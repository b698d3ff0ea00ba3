"""The DNA molecule of the thermal experiments, in water of room temperature. In nm, pN, us."""

import rodjax as rx

KT = 4.114  # [pN nm]
PERSISTENCE = 50.0  # [nm]
A, C = PERSISTENCE * KT, 2 * PERSISTENCE * KT  # [pN nm^2]
DIAMETER = 2.0  # [nm]
DRAG = (3e-3, 1.5e-3, 0.025)  # normal, tangential [pN us/nm^2], of spin [pN us]
BATH = rx.Bath(KT)
# salt of 10 mM: k_B T l_B (charges per length)^2 [pN], Debye length [nm]; with those of 100 mM the
# hat curve's strands passed through each other
CHARGES = rx.DebyeHueckel(strength=KT * 0.7 * 2.4**2, screening=3.0, floor=0.5)
# what is nearer along the molecule does not repel [nm]. With 25 nm, at 2 pN, strands passed
# where the first loop formed, under 36 pN nm of torque; with 15 nm they do not
EXCLUSION = 15.0


def molecule(length: float, elements: int, stiffer: float = 10.0) -> rx.Rod:
    """A straight one along z, whose elements yield as thermal rods must."""
    section = rx.Section(stiffness=(A, A, C), diameter=DIAMETER)
    return rx.yielding(rx.straight_rod(length, elements, section), stiffer)
