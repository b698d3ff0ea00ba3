"""Types of what users may give where the library holds an array."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array

Number = float | int
AnyArray = Array | np.ndarray
"""An array, whether traced or held by numpy; `Float[AnyArray, "nodes 3"]` adds its shape."""
Vector = Sequence[Number | AnyArray] | AnyArray
"""Three components; one by one they may be traced too."""
