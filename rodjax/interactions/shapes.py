"""Shapes of obstacles: signed distances from surfaces, positive where a rod may be."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rodjax.inputs.user_functions import check_function, returned
from rodjax.inputs.validation import (
    as_float,
    as_traced,
    check_arrays_of_numbers,
    check_finite,
    check_flag,
    check_positive,
    check_scalar,
    check_shape,
    known,
)
from rodjax.interactions import surfaces


class AbstractShape(eqx.Module):
    """Surface of an obstacle, where that is at first; your own is a subclass with `distance`.

    Example:
        >>> isinstance(rx.Plane(), rx.AbstractShape)
        True
    """

    @abc.abstractmethod
    def distance(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Signed distance of a point from the surface [m], negative inside the obstacle.

        Its gradient is the outer normal, of length one near the surface. Twice differentiable
        but for places that a rod does not come to.
        """

    def distance_and_normal(
        self, point: Float[Array, "3"]
    ) -> tuple[Float[Array, ""], Float[Array, "3"]]:
        """The distance and its gradient."""
        return jax.value_and_grad(self.distance)(point)

    @property
    def convex_room(self) -> bool:
        """Whether the room outside the obstacle is convex: no straight line between two places in
        it enters the obstacle, so that no rod has it between two of its points.
        """
        return False

    def patches(
        self, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
    ) -> list[Float[np.ndarray, "i j 3"]]:
        """Grids of points on the surface, to draw it by; none: it is found by its distance.

        Args:
            low, high: corners of the box that is looked at [m].
        """
        return []


def _vector(**values):
    check_shape((3,), **values)
    check_finite(**values)


def _direction(**values):
    """Three components, not all zero."""
    _vector(**values)
    for name, value in values.items():
        if known(value) and not np.any(np.asarray(value)):
            raise ValueError(f"{name}: must not be zero, got {np.asarray(value)}")


def _unit(vector):
    return vector / jnp.sqrt(jnp.sum(vector**2))


def _length(vector):
    """Of a vector, with a zero derivative where it vanishes."""
    squared = jnp.sum(vector**2)
    nowhere = squared == 0
    return jnp.where(nowhere, 0.0, jnp.sqrt(jnp.where(nowhere, 1.0, squared)))


class Plane(AbstractShape):
    """A plane; a rod may be on the side that its normal points to.

    Attributes:
        point: any of its points, inertial components [m].
        normal: of any length.

    Example:
        >>> slope = rx.Plane(point=(0, 0, -1), normal=(0.1, 0, 1))
    """

    point: Float[Array, "3"] = eqx.field(converter=as_float, default=(0.0, 0.0, 0.0))
    normal: Float[Array, "3"] = eqx.field(converter=as_float, default=(0.0, 0.0, 1.0))

    def __check_init__(self):
        _vector(point=self.point)
        _direction(normal=self.normal)

    def distance(self, point):
        return self.distance_and_normal(point)[0]

    def distance_and_normal(self, point):
        normal = _unit(self.normal)
        return jnp.sum((point - self.point) * normal), normal

    @property
    def convex_room(self):
        return True

    def patches(self, low, high):
        return [surfaces.plane(np.asarray(self.point), np.asarray(self.normal), low, high)]


class Sphere(AbstractShape):
    """A sphere, from outside or, as a bowl, from inside.

    Attributes:
        centre: inertial components [m].
        radius: [m].
        inside: whether a rod is inside it.

    Example:
        >>> ball = rx.Obstacle(rx.Sphere(centre=(0.5, 0, -0.3), radius=0.1), stiffness=1e5)
    """

    centre: Float[Array, "3"] = eqx.field(converter=as_float)
    radius: Float[Array, ""] = eqx.field(converter=as_float)
    inside: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        _vector(centre=self.centre)
        check_scalar(radius=self.radius)
        check_positive(radius=self.radius)
        check_flag(inside=self.inside)

    def distance(self, point):
        beyond = _length(point - self.centre) - self.radius
        return -beyond if self.inside else beyond

    @property
    def convex_room(self):
        return self.inside

    def patches(self, low, high):
        return [surfaces.sphere(np.asarray(self.centre), float(self.radius))]


class Cylinder(AbstractShape):
    """An endless cylinder: a drum from outside; a pipe or channel from inside.

    Attributes:
        point: any point of its axis, inertial components [m].
        axis: its direction, of any length.
        radius: [m].
        inside: whether a rod is inside it.

    Example:
        >>> pipe = rx.Cylinder(point=(0, 0, 0), axis=(1, 0, 0), radius=0.05, inside=True)
    """

    point: Float[Array, "3"] = eqx.field(converter=as_float)
    axis: Float[Array, "3"] = eqx.field(converter=as_float)
    radius: Float[Array, ""] = eqx.field(converter=as_float)
    inside: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        _vector(point=self.point)
        _direction(axis=self.axis)
        check_scalar(radius=self.radius)
        check_positive(radius=self.radius)
        check_flag(inside=self.inside)

    def distance(self, point):
        axis, arm = _unit(self.axis), point - self.point
        beyond = _length(arm - jnp.sum(arm * axis) * axis) - self.radius
        return -beyond if self.inside else beyond

    @property
    def convex_room(self):
        return self.inside

    def patches(self, low, high):
        line = np.asarray(self.point), np.asarray(self.axis)
        return [surfaces.cylinder(*line, float(self.radius), low, high)]


class HeightField(AbstractShape):
    """Ground over the x-y plane, of heights on a grid; a rod may be above it.

    Between the grid's points bicubic, with continuous slopes (Catmull and Rom); beyond its edges
    it goes on level. The distance is (z - h)/sqrt(1 + |grad h|^2), exact to first order near the
    ground: hills should be wide beside the rod.

    Attributes:
        heights: z of the ground, rows along x, columns along y, at least two each [m].
        origin: x and y of the first row and column [m].
        spacing: of rows and of columns [m].

    Example:
        >>> x = np.linspace(0, 1, 20)
        >>> heights = 0.05 * np.outer(np.sin(6 * x), np.ones(20)) - 1
        >>> hills = rx.HeightField(heights, spacing=(0.05, 0.05))
    """

    heights: Float[Array, "i j"] = eqx.field(converter=as_float)
    origin: Float[Array, "2"] = eqx.field(converter=as_float, default=(0.0, 0.0))
    spacing: Float[Array, "2"] = eqx.field(converter=as_float, default=(1.0, 1.0))

    def __check_init__(self):
        shape = jnp.shape(self.heights)
        if len(shape) != 2 or min(shape) < 2:
            raise ValueError(
                f"heights: give a grid of at least two rows and columns, got shape {shape}"
            )
        check_shape((2,), origin=self.origin, spacing=self.spacing)
        check_finite(heights=self.heights, origin=self.origin)
        check_positive(spacing=self.spacing)

    def height(self, place: Float[Array, "2"]) -> Float[Array, ""]:
        """z of the ground at x and y [m]."""
        rows, columns = self.heights.shape
        last = jnp.asarray([rows - 1, columns - 1], jnp.int32)
        at = jnp.clip((place - self.origin) / self.spacing, 0.0, last.astype(place.dtype))
        cell = jnp.minimum(jnp.floor(at).astype(jnp.int32), last - 1)
        part = at - cell.astype(at.dtype)
        around = jnp.arange(-1, 3, dtype=jnp.int32)
        index = jnp.clip(cell[:, None] + around[None], 0, last[:, None])
        weights = jax.vmap(_catmull_rom)(part)
        return weights[0] @ self.heights[index[0][:, None], index[1][None]] @ weights[1]

    def distance(self, point):
        height, slope = jax.value_and_grad(self.height)(point[:2])
        return (point[2] - height) / jnp.sqrt(1 + jnp.sum(slope**2))

    def patches(self, low, high):
        size = np.asarray(self.spacing) * (np.asarray(self.heights.shape) - 1)
        first = np.asarray(self.origin)
        flat = surfaces.grid(np.minimum(low[:2], first), np.maximum(high[:2], first + size), 65)
        heights = np.asarray(jax.vmap(jax.vmap(self.height))(jnp.asarray(flat)))
        return [np.concatenate([flat, heights[..., None]], -1)]


def _catmull_rom(t: Float[Array, ""]) -> Float[Array, "4"]:
    """Weights of the four values around a place t in (0, 1) between the middle ones."""
    return 0.5 * jnp.stack(
        [
            -t + 2 * t**2 - t**3,
            2 - 5 * t**2 + 3 * t**3,
            t + 4 * t**2 - 3 * t**3,
            -(t**2) + t**3,
        ]
    )


class SignedDistance(AbstractShape):
    """A surface of your own, by its signed distance.

    Attributes:
        function: called as `function(parameters, point)` with a point (3,), inertial components
            [m]; returns its signed distance from the surface, negative inside the obstacle.
            Written with jax.numpy, of a gradient of length one near the surface, and twice
            differentiable there (round edges off).
        parameters: any pytree of numbers and arrays, which can be differentiated and change
            without a new compilation (the function cannot: pass the same).

    Example:
        >>> def bowl(radius, point):
        ...     return radius - jnp.sqrt(jnp.sum(point**2) + 1e-12)
        >>> inside = rx.Obstacle(rx.SignedDistance(bowl, 2.0), stiffness=1e5)
    """

    function: Callable = eqx.field(static=True)
    parameters: object = eqx.field(converter=as_traced, default=None)

    def __check_init__(self):
        check_function(function=self.function)
        check_arrays_of_numbers(parameters=self.parameters)
        point = jax.ShapeDtypeStruct((3,), jnp.result_type(float))
        found = returned("function", self.function, self.parameters, point).shape
        if found != ():
            raise ValueError(
                f"function: must return one number, the distance of one point, got shape {found}"
            )

    def distance(self, point):
        return self.function(self.parameters, point)
