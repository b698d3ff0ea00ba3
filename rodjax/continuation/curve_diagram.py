"""What a curve of critical points is given out as."""

import equinox as eqx
import numpy as np

from rodjax.continuation.diagram import CriticalPoint, PathEnd
from rodjax.numerics.results import Result


class CriticalCurve(eqx.Module):
    """Critical points of two parameters, in the order in which the curve passes them.

    Attributes:
        parameters: the critical loads, of each point.
        others: the second parameter, of each point.
        points: the critical points themselves.
        cusps: both parameters where both turn back at once, each.
        end: why the curve ended.
        result: a `Result` as a number: 0 unless `end` is FAILED.

    Example:
        >>> print(rx.critical_curve(turned, point, 0.0, 0.3))  # doctest: +SKIP
        curve of 8 critical points, second parameter 0 to 0.3: the parameter reached the value asked
    """

    parameters: np.ndarray
    others: np.ndarray
    points: tuple[CriticalPoint, ...]
    cusps: np.ndarray
    end: PathEnd
    result: int

    def __len__(self) -> int:
        return len(self.parameters)

    def __str__(self) -> str:
        lines = [
            f"curve of {len(self)} critical points, second parameter {self.others[0]:g} to"
            f" {self.others[-1]:g}: {self.end.value}"
        ]
        if self.result:
            lines.append(f"  {Result(self.result)}")
        lines += [f"  cusp at ({one[0]:.9g}, {one[1]:.9g})" for one in self.cusps]
        return "\n".join(lines)
