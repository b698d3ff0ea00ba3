"""An energy ledger in a few lines: what stands in it at the end."""

from typing import TYPE_CHECKING

import numpy as np

from rodjax.inputs.sheets import Sheet, quantity
from rodjax.inputs.units import used
from rodjax.inputs.validation import all_known

if TYPE_CHECKING:
    from rodjax.measuring.energy import Ledger


def sheet_of_ledger(ledger: "Ledger") -> Sheet:
    """Of what is traced, or of a batch, the shapes."""
    if not all_known(*ledger) or np.ndim(ledger.time) != 1 or not len(ledger.time):
        shape = getattr(ledger.time, "shape", ())
        return Sheet(f"Ledger of shape {tuple(shape)}")
    u, times = used(), np.asarray(ledger.time)
    known = {name: np.asarray(x) for name, x in ledger._asdict().items() if x is not None}
    del known["time"]
    largest = {name: np.max(np.abs(values)) for name, values in known.items()}
    # what is not is left out, and what rounding left of it
    least = 1e-9 * max(largest.values())
    rows = [
        (name.replace("_", " "), quantity(values[-1], u.energy))
        for name, values in known.items()
        if not largest[name] <= least
    ]
    most = float(np.max(np.abs(np.asarray(ledger.residual)), initial=0.0))
    rows.append(("not accounted for", f"{quantity(most, u.energy)} at most"))
    span = f"{times[0]:.6g} to {times[-1]:.6g} {u.time}, {len(times)} times"
    return Sheet(f"Ledger over {span}; at its end:", tuple(rows))
