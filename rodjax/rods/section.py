"""Section properties along the rod: stiffness, inertia, compliance, thickness."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rodjax.inputs.argument_types import AnyArray, Number
from rodjax.inputs.sheets import sheet_of, told
from rodjax.inputs.units import used
from rodjax.inputs.user_functions import called
from rodjax.inputs.validation import (
    as_float,
    check_flag,
    check_instance,
    check_numbers,
    check_positive,
    check_scalar,
    given,
    known,
    made_array,
    shown,
)
from rodjax.rods.material import AbstractMaterial

Property = Number | AnyArray | Callable[[np.ndarray], np.ndarray]
Three = Sequence[Property | Sequence[Number | AnyArray]] | AnyArray
"""Three properties, or three components an element."""

# what three components are, for messages
STIFFNESS = (
    "(A1, A2, C), bending about a_1 and a_2 and torsion; for a round rod (A, A, C);"
    " or symmetric matrices (3, 3) or (elements, 3, 3)"
)
COUPLING = "entries (1, 2), (1, 3), (2, 3) of the symmetric stiffness; None for a diagonal one"
CURVATURE = "(kappa_1, kappa_2, twist) in the body frame; for none (0, 0, 0)"
INERTIA = "per length about a_1, a_2, a_3; None leaves it out"
COMPLIANCE = "(1/GA1, 1/GA2, 1/EA), shear and stretch; None for a rod that does neither"


class Section(eqx.Module):
    """Section properties: each a number, values per element, or a function of arc length.

    A function is given the arc lengths of all element centres at once and returns a value for
    each (or one for all). Where a field has three components give each by itself, or an array
    (elements, 3). Axes are those of the body frame: a_1 and a_2 across the rod, a_3 along it.

    Attributes:
        stiffness: (A1, A2, C): bending about a_1 and a_2 and torsion [N m^2]; EI_1, EI_2 and GJ.
            Or the symmetric matrix B, (3, 3) or one an element (elements, 3, 3).
        mass: per length [kg/m]; None for a rod without inertia, which drag balances.
        rotary_inertia: (I1, I2, I3): moments of inertia per length about a_1, a_2, a_3 [kg m];
            None leaves rotary inertia out.
        compliance: (1/GA1, 1/GA2, 1/EA): shear along a_1 and a_2 and stretch, with the shear
            factor where there is one [1/N]; None for a rod without shear and stretch.
        diameter: [m]; of drag and contact.
        area: of the section [m^2]; of buoyancy and added mass.
        coupling: (B12, B13, B23): of both bendings, and of twist with bending about a_1 and about
            a_2, if stiffness gives the diagonal alone [N m^2]; None for none.
        torque_per_tension: b of a cable laid of strands [m]: a tension N twists it with b N, and a
            twist tau shortens it by b tau, M3 = C tau + b N and stretch N/EA - b tau (with or
            without compliance).
        material: how elements resist, such as `KelvinVoigt` or an `AbstractMaterial` of your own;
            None for a linear rod.

    Example:
        >>> ribbon = rx.Section(stiffness=(2e-3, 2e-5, 1e-4), mass=0.02)
        >>> rx.straight_rod(1.0, 10, ribbon).stiffness.shape
        (10, 3)
    """

    stiffness: Three
    mass: Property | None = None
    rotary_inertia: Three | None = None
    compliance: Three | None = None
    diameter: Property | None = None
    area: Property | None = None
    coupling: Three | None = None
    torque_per_tension: Property | None = None
    material: AbstractMaterial | None = None

    def __str__(self) -> str:
        return sheet_of(self).text

    def _repr_html_(self) -> str:
        return sheet_of(self).html

    def __check_init__(self):
        optional = ("rotary_inertia", "compliance", "coupling")
        triples = given(**{name: getattr(self, name) for name in optional})
        meanings = {"rotary_inertia": INERTIA, "compliance": COMPLIANCE, "coupling": COUPLING}
        if as_matrices(self.stiffness) is None:
            check_components(STIFFNESS, stiffness=self.stiffness)
        elif self.coupling is not None:
            raise ValueError("coupling: the matrix of the stiffness holds it already; give one")
        for name, value in triples.items():
            check_components(meanings[name], **{name: value})
        names = ("mass", "diameter", "area", "torque_per_tension")
        check_property(**given(**{name: getattr(self, name) for name in names}))
        if self.material is not None:
            mend = "give a material such as KelvinVoigt(1e-3), or None for a linear rod"
            check_instance(AbstractMaterial, mend, material=self.material)


def as_matrices(stiffness: Any) -> Any:
    """The stiffness where it is given as matrices, (3, 3) or (n, 3, 3); None where it is not.

    Rows of numbers that are not symmetric are three components of three elements.
    """
    nested = isinstance(stiffness, list | tuple) and any(
        isinstance(row, list | tuple) or hasattr(row, "shape") for row in stiffness
    )
    if not (nested or hasattr(stiffness, "shape")):
        return None
    found = made_array(stiffness)
    shape = getattr(found, "shape", ())
    if shape[-2:] != (3, 3) or len(shape) > 3:
        return None
    symmetric = not known(found) or np.allclose(found, np.swapaxes(found, -1, -2), rtol=1e-9)
    if len(shape) == 3 and not symmetric:
        raise ValueError("stiffness: must be symmetric in every element (it has an energy)")
    return found if symmetric else None


def diagonal_and_coupling(matrices: Any, elements: int) -> tuple[Any, Any]:
    """(n, 3) of the diagonal, and (n, 3) of the entries (1, 2), (1, 3), (2, 3)."""
    shape = (elements, 3, 3)
    if matrices.ndim == 3 and matrices.shape != shape:
        raise ValueError(f"stiffness: expected {shape}, a matrix an element; got {matrices.shape}")
    full = jnp.broadcast_to(jnp.asarray(as_float(matrices), jnp.result_type(float)), shape)
    return jnp.diagonal(full, axis1=1, axis2=2), full[:, (0, 0, 1), (1, 2, 2)]


def check_property(**properties) -> None:
    """Raise ValueError unless each is real numbers or a function."""
    for name, value in properties.items():
        if isinstance(value, type) or not callable(value):
            check_numbers(**{name: value})


def check_components(meaning: str, **properties) -> None:
    """Raise ValueError unless each is three properties, or an array with three a row."""
    for name, value in properties.items():
        refusal = f"{name}: give three components, {meaning}; got {shown(value)}"
        if hasattr(value, "shape"):
            check_numbers(**{name: value})
            if 3 not in value.shape or len(value.shape) > 2:
                raise ValueError(refusal)
            continue
        if not isinstance(value, list | tuple):
            raise ValueError(refusal)
        if len(value) == 3:
            for part in value:
                check_property(**{name: part})
        elif not value or any(getattr(made_array(row), "shape", ()) != (3,) for row in value):
            raise ValueError(refusal)


def sample(value: Property, midpoints: AnyArray, name: str) -> Array:
    """Values per element of a constant, an array or a function of s (taken at the centres)."""
    if callable(value) and not isinstance(value, type):
        hint = "it is given all arc lengths at once: numpy.where takes the place of `if`"
        value = called(name, value, midpoints, hint=hint)
    check_numbers(**{name: value})
    result = jnp.asarray(as_float(value), jnp.result_type(float))
    if result.ndim == 0:
        return jnp.broadcast_to(result, midpoints.shape)
    if result.shape != midpoints.shape:
        raise ValueError(
            f"{name}: give a number, a function of s, or {midpoints.size} values (one an element);"
            f" got shape {result.shape}"
        )
    return result


def components(value: Any, midpoints: AnyArray, name: str, meaning: str) -> Array:
    """Values (n, 3) of three properties or of an array (n, 3)."""
    check_components(meaning, **{name: value})
    n = midpoints.shape[0]
    shape = value.shape if hasattr(value, "shape") else (len(value),)
    if len(shape) == 2 and n == 3:
        raise ValueError(
            f"{name}: of three elements an array of shape {shape} may hold the components in its"
            " rows or its columns; give a tuple of three components"
        )
    rows = value if len(shape) == 2 else None
    if shape == (n,) and n != 3:
        rows = made_array(value)  # a list of rows
    if rows is not None and rows.shape == (n, 3):
        return jnp.asarray(as_float(rows), jnp.result_type(float))
    if shape[0] != 3:
        got = tuple(made_array(value).shape)
        raise ValueError(f"{name}: expected shape {(n, 3)} for {n} elements, got {got}")
    return jnp.stack([sample(part, midpoints, name) for part in value], -1)


def circular_section(
    diameter: Property,
    youngs_modulus: Number | Array,
    shear_modulus: Number | Array,
    density: Number | Array | None,
    *,
    rotary_inertia: bool = True,
    extensible: bool = False,
    shear_factor: Number = 1.0,
    material: AbstractMaterial | None = None,
) -> Callable[[np.ndarray], Section]:
    """Solid circular section: A_c = pi D^2/4, A1 = A2 = E A_c D^2/16, C = G A_c D^2/8.

    Args:
        diameter: D [m]; a number, values per element, or a function of arc length.
        youngs_modulus: E [Pa].
        shear_modulus: G [Pa]; E/(2 (1 + nu)), E/3 of rubber.
        density: [kg/m^3]; None for a rod without inertia.
        rotary_inertia: False leaves I = rho J out.
        extensible: True adds the shear and axial compliances 1/(k G A_c) and 1/(E A_c).
        shear_factor: k.
        material: see `Section`.

    Returns a function of the arc lengths of the element centres, for the builders of rods.
    Source: Table 1 of Goyal, Perkins & Lee.

    Example:
        >>> rubber = rx.circular_section(0.01, 1.2e6, 0.4e6, density=1100.0)
        >>> float(rx.straight_rod(1.0, 10, rubber).stiffness[0, 0])  # E pi D^4/64
        0.0005890486225480862
    """
    check_flag(rotary_inertia=rotary_inertia, extensible=extensible)
    check_property(diameter=diameter)
    numbers = {
        "youngs_modulus": youngs_modulus,
        "shear_modulus": shear_modulus,
        "shear_factor": shear_factor,
        **given(density=density),
    }
    check_scalar(**numbers)
    check_positive(**numbers)
    moduli = [as_float(value) for value in (youngs_modulus, shear_modulus, shear_factor)]
    given_weight = None if density is None else as_float(density)

    def at(midpoints: AnyArray) -> Section:
        d = sample(diameter, midpoints, "diameter")
        check_positive(diameter=d)
        # each number may have been given in single precision
        numbers = [d, *moduli] if given_weight is None else [d, *moduli, given_weight]
        kind = np.result_type(*(number.dtype for number in numbers))
        d, youngs, shear, factor, *weights = (number.astype(kind) for number in numbers)
        weight = weights[0] if weights else None
        area = jnp.pi * d**2 / 4
        bend = area * d**2 / 16
        inertia = None if weight is None or not rotary_inertia else weight * bend
        soft = 1 / (factor * shear * area)
        return Section(
            stiffness=(youngs * bend, youngs * bend, 2 * shear * bend),
            mass=None if weight is None else weight * area,
            rotary_inertia=None if inertia is None else (inertia, inertia, 2 * inertia),
            compliance=(soft, soft, 1 / (youngs * area)) if extensible else None,
            diameter=d,
            area=area,
            material=material,
        )

    words = numbers | {"diameter": diameter} | given(material=material)
    return _Circular(at, words)


class _Circular:
    """A function of arc lengths that says what it was made of."""

    def __init__(self, at: Callable[[AnyArray], Section], words: dict[str, Any]):
        self._at, self._words = at, words

    def __call__(self, midpoints: AnyArray) -> Section:
        return self._at(midpoints)

    def __repr__(self) -> str:
        u = used()
        modulus = f"{u.force}/{u.length}^2"
        own = {"youngs_modulus": modulus, "shear_modulus": modulus, "diameter": u.length}
        own["density"] = f"{u.mass}/{u.length}^3"
        said = (f"{name}={told(value, own.get(name))}" for name, value in self._words.items())
        return f"circular_section({', '.join(said)})"
