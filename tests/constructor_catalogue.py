"""Constructors: what builds, and of every argument a valid value and its oracle."""

import inspect

import jax.numpy as jnp
import numpy as np
from constructor_oracles import (
    N,
    array_of,
    count,
    direction,
    finite,
    flag,
    frames,
    inner_node,
    instance,
    jumps,
    node,
    not_negative,
    one_precision,
    optional,
    original,
    perhaps_a_function,
    positive,
    property_of,
    real_array,
    rising,
    rows,
    schedule,
    triple_of,
)

import rodjax as rx
from rodjax.inputs.units import Units

SECTION = rx.circular_section(0.01, 1e7, 4e6, 1500.0)
ROD = rx.straight_rod(1.0, N, SECTION)
PLAIN = rx.Scene(ROD, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)),))
ONE = rx.PiecewiseLinear([0.0, 1.0], [0.0, 1.0])
THREE = rx.PiecewiseLinear([0.0, 1.0], np.eye(3)[:2])
TURN = rx.Turn((0, 0, 1), ONE)


def circle(s):
    return jnp.stack([jnp.sin(s), jnp.cos(s), 0 * s])


def push(parameters, s, motion):
    return jnp.zeros((s.shape[0], 6)) + 0.0 * motion.position[:, :1]


def placed(**fields):
    return rx.Rod(**fields)


def scene(*ends, loads=()):
    return rx.Scene(ROD, *ends, loads=loads)


POSITION = np.asarray(ROD.position)
CATALOGUE = {
    "straight_rod": (
        rx.straight_rod,
        {
            "length": (1.0, positive),
            "elements": (N, count(2, 1_000_000)),
            "section": (SECTION, original(SECTION)),
            "direction": ([0.3, -2.0, 1.0], direction),
            "first_director": (None, lambda v: v is None or (None if direction(v) else False)),
            "origin": ([1.0, 2.0, 3.0], array_of((3,))),
            "natural_curvature": ([0.1, 0.0, 2.0], triple_of(-np.inf, False, False)),
            "jumps": ((), jumps),
        },
    ),
    "curved_rod": (
        rx.curved_rod,
        {
            "curve": (circle, original(circle)),
            "length": (1.0, lambda v: positive(v) and (None if np.asarray(v) > 1e3 else True)),
            "elements": (N, count(2, 1_000_000)),
            "section": (SECTION, original(SECTION)),
            "stress_free": (True, flag),
        },
    ),
    "circular_section": (
        lambda **k: rx.straight_rod(1.0, N, rx.circular_section(**k)),
        {
            "diameter": (0.01, property_of(0, True, False)),
            "youngs_modulus": (1e7, positive),
            "shear_modulus": (4e6, positive),
            "density": (1500.0, optional(positive)),
            "rotary_inertia": (True, flag),
            "extensible": (False, flag),
            "shear_factor": (0.9, positive),
        },
    ),
    "Section": (
        lambda **k: rx.straight_rod(1.0, N, rx.Section(**k)),
        {
            "stiffness": ((1.0, 1.3, 0.8), triple_of(0, True, False)),
            "mass": (1.0, property_of(0, True, True)),
            "rotary_inertia": (None, triple_of(0, False, True)),
            "compliance": (None, triple_of(0, False, True)),
            "diameter": (0.01, property_of(0, True, True)),
            "area": (1e-4, property_of(0, True, True)),
        },
    ),
    "Rod": (
        placed,
        {
            "position": (POSITION, array_of((N + 1, 3))),
            "quaternion": (np.asarray(ROD.quaternion), lambda v: None if frames(v) else False),
            "length": (np.full(N, 1 / N), array_of((N,), 0, strict=True)),
            "stiffness": (np.ones((N, 3)), array_of((N, 3), 0, strict=True)),
            "natural_curvature": (np.zeros((N, 3)), array_of((N, 3))),
            "mass": (np.ones(N), array_of((N,), 0, strict=True, optional=True)),
            "rotary_inertia": (None, array_of((N, 3), 0, optional=True)),
            "compliance": (np.zeros((N, 3)), array_of((N, 3), 0, optional=True)),
            "diameter": (None, array_of((N,), 0, strict=True, optional=True)),
            "area": (np.full(N, 1e-4), array_of((N,), 0, strict=True, optional=True)),
        },
    ),
    "Turn": (
        lambda **k: scene(rx.Clamped(rotation=rx.Turn(**k))),
        {"axis": ((0, 0, 1), direction), "angle": (ONE, schedule(()))},
    ),
    "Free": (
        lambda **k: scene(rx.Free(**k)),
        {"displacement": (None, original(None)), "rotation": (None, original(None))},
    ),
    "Clamped": (
        lambda **k: scene(rx.Clamped(**k)),
        {
            "displacement": (THREE, optional(schedule((3,)))),
            "rotation": (TURN, optional(instance(rx.Turn))),
        },
    ),
    "Pinned": (
        lambda **k: scene(rx.Pinned(**k)),
        {
            "displacement": (THREE, optional(schedule((3,)))),
            "rotation": (None, original(None)),
        },
    ),
    "Slider": (
        lambda **k: scene(rx.Clamped(), rx.Slider(**k)),
        {
            "axis": ((0, 0, 1), direction),
            "displacement": (THREE, optional(schedule((3,)))),
            "rotation": (TURN, optional(instance(rx.Turn))),
        },
    ),
    "Switched": (
        lambda **k: scene(rx.Clamped(), rx.Switched(**k)),
        {
            "before": (rx.Free(), instance(rx.AbstractEnd)),
            "after": (rx.Clamped(), instance(rx.AbstractEnd)),
            "at": (1.0, finite),
            "displacement": (None, optional(schedule((3,)))),
            "rotation": (None, optional(instance(rx.Turn))),
        },
    ),
    "Support": (
        lambda **k: rx.Scene(ROD, rx.Clamped(), supports=(rx.Support(**k),)),
        {"node": (3, inner_node), "end": (rx.Pinned(), instance(rx.AbstractEnd))},
    ),
    "Lump": (
        lambda **k: rx.Scene(ROD, rx.Clamped(), lumps=(rx.Lump(-1, **k),)),
        {
            "mass": (0.5, positive),
            "inertia": (None, lambda v: True if v is None else None),
            "offset": (None, optional(array_of((3,)))),
            "volume": (None, optional(not_negative)),
        },
    ),
    "Body": (
        lambda **k: rx.Scene(ROD, rx.Clamped(), bodies=(rx.Body(**k),)),
        {
            "mass": (0.5, positive),
            "inertia": ((1.0, 1.0, 1.0), lambda v: False if v is None else None),
            "position": ((0.0, 1.0, 0.0), array_of((3,))),
            "quaternion": ((1.0, 0.0, 0.0, 0.0), lambda v: None if array_of((4,))(v) else False),
            "volume": (None, optional(not_negative)),
            "end": (rx.Free(), instance(rx.AbstractEnd)),
        },
    ),
    "PointDrag": (
        lambda **k: scene(loads=(rx.PointDrag(-1, **k),)),
        {
            "linear": (1.0, not_negative),
            "quadratic": (1.0, not_negative),
            "rotational": (0.1, not_negative),
            "current": (None, optional(array_of((3,)))),
            "offset": (None, optional(array_of((3,)))),
        },
    ),
    "Constant": (
        rx.Constant,
        {
            "value": (
                1.0,
                lambda v: (a := real_array(v)) is not None and bool(np.all(np.isfinite(a))),
            )
        },
    ),
    "PiecewiseLinear": (
        rx.PiecewiseLinear,
        {"times": ([0.0, 1.0, 3.0], rising), "values": ([0.0, 1.0, 0.0], rows)},
    ),
    "PiecewiseLinearRate": (
        rx.PiecewiseLinearRate,
        {"times": ([0.0, 1.0, 3.0], rising), "rates": ([0.0, 1.0, 0.0], rows)},
    ),
    "Smooth": (
        rx.Smooth,
        {"times": ([0.0, 1.0, 3.0], rising), "values": ([0.0, 1.0, 0.0], rows)},
    ),
    "Function": (
        lambda **k: scene(rx.Clamped(rotation=rx.Turn((0, 0, 1), rx.Function(**k)))),
        {
            "function": (
                jnp.sin,
                lambda v: None if callable(v) and not inspect.isclass(v) else False,
            ),
            "last": (10.0, array_of((), -np.inf, strict=False, infinite=True)),
        },
    ),
    "Gravity": (
        lambda **k: scene(loads=(rx.Gravity(**k),)),
        {
            "acceleration": ((0.0, 0.0, -9.81), array_of((3,))),
            "fluid_density": (None, optional(not_negative)),
        },
    ),
    "MorisonDrag": (
        lambda **k: scene(loads=(rx.MorisonDrag(**k),)),
        {
            "fluid_density": (1e3, not_negative),
            "normal_coefficient": (1.2, not_negative),
            "tangential_coefficient": (0.02, not_negative),
            "current": ((0.1, 0.0, 0.0), optional(array_of((3,)))),
            "added_mass_coefficient": (1.0, optional(not_negative)),
        },
    ),
    "LinearDrag": (
        lambda **k: scene(loads=(rx.LinearDrag(**k),)),
        {
            "normal": (1.0, not_negative),
            "tangential": (1.0, not_negative),
            "rotational": (0.1, not_negative),
        },
    ),
    "PointLoad": (
        lambda **k: scene(loads=(rx.PointLoad(**k),)),
        {
            "node": (-1, node),
            "force": (THREE, optional(schedule((3,)))),
            "moment": (None, optional(schedule((3,)))),
            "follower": (False, flag),
        },
    ),
    "DistributedLoad": (
        lambda **k: scene(loads=(rx.DistributedLoad(**k),)),
        {
            "function": (push, perhaps_a_function),
            "parameters": (1.0, lambda v: getattr(v, "dtype", np.dtype(float)).kind in "biufc"),
        },
    ),
    "GeneralizedAlpha": (
        rx.GeneralizedAlpha,
        {
            "spectral_radius": (0.5, lambda v: not_negative(v) and bool(np.all(np.asarray(v) < 1))),
            "tolerance": (1e-9, optional(positive)),
            "max_iterations": (10, count(1, 10_000)),
        },
    ),
    "StepControl": (
        rx.StepControl,
        {name: (0.01, positive) for name in ("relative", "absolute", "twisting")}
        | {name: (0.01, optional(positive)) for name in ("max_step", "first_step", "min_step")},
    ),
    "Units": (
        Units,
        {
            name: ("m", lambda v: isinstance(v, str) and bool(v))
            for name in ("length", "time", "mass", "force")
        },
    ),
    "Scene": (
        rx.Scene,
        {
            "rod": (ROD, instance(rx.Rod)),
            "first_end": (rx.Clamped(), instance(rx.AbstractEnd)),
            "last_end": (rx.Free(), instance(rx.AbstractEnd)),
            "loads": ((), lambda v: v == () if isinstance(v, tuple) else False),
            "contact": (None, original(None)),
        },
    ),
    "start": (
        lambda **k: rx.start(PLAIN, **k),
        {
            "position": (None, lambda v: v is None or (None if array_of((N + 1, 3))(v) else False)),
            "quaternion": (None, lambda v: v is None or (None if frames(v) else False)),
            "velocity": (None, array_of((N + 1, 3), optional=True)),
            "angular_velocity": (None, array_of((N + 1, 3), optional=True)),
            "time": (0.0, finite),
        },
    ),
}

BUILD, FIELDS = CATALOGUE["Rod"]
CATALOGUE["Rod"] = (BUILD, {k: (v, one_precision(oracle)) for k, (v, oracle) in FIELDS.items()})
