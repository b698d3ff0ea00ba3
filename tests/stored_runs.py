"""A stored run that was never computed, shared by the tests of files."""

from pathlib import Path

import numpy as np
from helpers import standing_run

from rodjax import storage
from rodjax.constraints import ends
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_laws import Barrier
from rodjax.interactions.loads import Gravity, LinearDrag
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section
from rodjax.scenes.scene import Scene

SECTION = Section((1.0, 1.0, 0.8), mass=1.0, rotary_inertia=(1e-3, 1e-3, 2e-3), diameter=0.02)


def stored_run(path: Path) -> tuple[Path, storage.Stored]:
    """The file's path, and what is loaded from it."""
    rod = straight_rod(1.0, 8, SECTION)
    contact = Contact(Barrier(1e6), segments=8, cutoff=0.05)
    held = ends.Switched(ends.Free(), ends.Clamped(), 0.4)
    loads = (LinearDrag(1.0, 1.0, 0.1), Gravity((0.0, 0.0, -1.0)))
    scene = Scene(rod, ends.Clamped(), held, loads, contact)
    storage.save(path, scene, standing_run(scene, 4), measures={"gap": np.arange(5.0)})
    return path, storage.load(path)
