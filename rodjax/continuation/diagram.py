"""What a path of equilibria is given out as: its points, those that are critical, why it ended."""

import enum
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rodjax.measuring.reactions import Reactions
from rodjax.numerics.results import Result
from rodjax.rods.state import State

Kind = Literal["fold", "branch"]


class CriticalPoint(eqx.Module):
    """An equilibrium whose tangent is singular: the path turns there, or another leaves it.

    Attributes:
        kind: "fold" where the parameter turns, "branch" where another path crosses.
        parameter: the critical load.
        state: the equilibrium.
        modes: motions that cost no energy, displacement [m] and body spin [rad] of every node, of
            unit norm (the integral of |spin|^2 + |displacement|^2/L^2 [m]). A branch point of a
            rod that may buckle into any direction has two.
        free: motions that cost nothing beside these (a buckled rod about its axis); zeros are none.
        unit: of the parameter, in which changes of it are compared with motions.
        origin: the state from which the schedules of the scenes count.
        result: a `Result` as a number; 0 is success.

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> scene = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn))
        >>> path = rx.path(scene, rx.placing(scene), 0.0, 3.0)
        >>> [(point.kind, round(float(point.parameter), 2)) for point in path.critical]
        [('branch', 2.16)]
    """

    kind: Kind = eqx.field(static=True)
    parameter: Float[Array, ""]
    state: State
    modes: Float[Array, "k nodes 6"]
    free: Float[Array, "m nodes 6"]
    unit: Float[Array, ""]
    origin: State
    result: Int[Array, ""]


class PathEnd(enum.Enum):
    """Why a path ended.

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> scene = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn))
        >>> path = rx.path(scene, rx.placing(scene), 0.0, 3.0)
        >>> path.end
        <PathEnd.STOP: 'the parameter reached the value asked'>
    """

    STOP = "the parameter reached the value asked"
    START = "the parameter returned to where the path began"
    TARGET = "a measure reached its target"
    POINTS = "the number of points asked was reached"
    CLOSED = "the path came back to its first point"
    VISITED = "the path came back to a point that it had passed"
    FAILED = "no further point was found"


class EquilibriumPath(eqx.Module):
    """Equilibria along a path, in the order in which it passes them.

    Arrays have a row for each point.

    Attributes:
        parameters: of each point.
        states: stacked states.
        arc: length along the path, in the mean square of spins [rad], displacements over L and of
            the parameter over `unit`.
        unstable: number of unstable modes (of loads without potential, only whether it is odd).
        eigenvalues: those of the second variation that are nearest to zero [N], by size, in the
            norm of `CriticalPoint.modes`.
        antisymmetry: of the tangent on their modes, over its symmetric part: more than rounding
            under loads without potential (followers, dead end moments), whose eigenvalues are not
            these. `stability` solves their general problem.
        energy: stored by strain, loads and contact [J].
        reactions: of what holds the rod.
        measures: what was asked for, by name.
        critical: folds and branch points, in the order in which the path passes them.
        unit: of the parameter.
        end: why the path ended.
        result: a `Result` as a number: 0 unless `end` is FAILED.

    Example:
        >>> turn = rx.Turn((1, 0, 0), rx.PiecewiseLinear([0.0, 3.0], [0.0, 6 * np.pi]))
        >>> scene = rx.Scene(rod, rx.Clamped(), rx.Slider((1, 0, 0), rotation=turn))
        >>> path = rx.path(scene, rx.placing(scene), 0.0, 3.0)
        >>> float(path.parameters[-1]), int(path.unstable[0]), int(path.unstable[-1])
        (3.0, 0, 2)
    """

    parameters: np.ndarray
    states: State
    arc: np.ndarray
    unstable: np.ndarray
    eigenvalues: np.ndarray
    antisymmetry: np.ndarray
    energy: np.ndarray
    reactions: Reactions
    measures: dict[str, Any]
    critical: tuple[CriticalPoint, ...]
    unit: float
    end: PathEnd
    result: int

    def state(self, index: int) -> State:
        """The state of one point."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), self.states)

    def __len__(self) -> int:
        return len(self.parameters)

    def __str__(self) -> str:
        lines = [
            f"path of {len(self)} equilibria, parameter {self.parameters[0]:g} to"
            f" {self.parameters[-1]:g}: {self.end.value}"
        ]
        if self.result:
            lines.append(f"  {Result(self.result)}")
        counts = np.unique(self.unstable)
        lines.append(f"  unstable modes: {', '.join(map(str, counts))}")
        lines += [f"  {one.kind} at {float(one.parameter):.9g}" for one in self.critical]
        return "\n".join(lines)
