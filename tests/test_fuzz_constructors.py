"""Constructors given anything, and short runs of scenes drawn at random.

Of every constructor valid arguments are drawn and one is replaced. An oracle of the argument's
kind, written apart from the package, says whether what was put there makes sense: then it must be
taken, else a ValueError must name the argument.
"""

import inspect
import re

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import rodjax as rx
from rodjax.units import Units

N = 6
SECTION = rx.circular_section(0.01, 1e7, 4e6, 1500.0)
ROD = rx.straight_rod(1.0, N, SECTION)
PLAIN = rx.Scene(ROD, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)),))
ONE = rx.PiecewiseLinear([0.0, 1.0], [0.0, 1.0])
THREE = rx.PiecewiseLinear([0.0, 1.0], np.eye(3)[:2])
TURN = rx.Turn((0, 0, 1), ONE)


@pytest.fixture(autouse=True)
def unchecked():
    """Without the tests' run-time type checks, which would come before the package's own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


# Oracles: True if the value makes sense, False if not, None if either answer will do


def real_array(value):
    """As numpy's array, if these are real numbers in a sequence or an array."""
    if isinstance(value, str | bytes | dict | bool) or value is None or callable(value):
        return None
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    if array.dtype == object and isinstance(value, int):
        return np.asarray(float(value)) if abs(value) < 1e300 else None
    return array if array.dtype.kind in "iuf" else None


def extreme(array):
    size = np.abs(array[array != 0])
    return bool(np.any((size > 1e20) | (size < 1e-20)))


def array_of(shape, low=-np.inf, high=np.inf, *, strict=False, optional=False, infinite=False):
    """Real numbers of a shape in a range (`strict`: without its bounds)."""

    def oracle(value):
        if value is None:
            return optional
        array = real_array(value)
        if array is None or array.shape != shape or np.any(np.isnan(array)):
            return False
        if not infinite and np.any(np.isinf(array)):
            return False
        inside = (array > low) & (array < high) if strict else (array >= low) & (array <= high)
        if not np.all(inside):
            return False
        return None if extreme(array) else True

    return oracle


positive = array_of((), 0, strict=True)
not_negative = array_of((), 0)
finite = array_of(())


def optional(oracle):
    return lambda value: True if value is None else oracle(value)


def count(low, high):
    def oracle(value):
        array = real_array(value)
        whole = array is not None and array.shape == () and float(array).is_integer()
        return whole and low <= array <= high

    return oracle


def node(value):
    array = real_array(value)
    integer = array is not None and array.shape == () and array.dtype.kind in "iu"
    return integer and -N - 1 <= array <= N


def direction(value):
    array = real_array(value)
    good = array is not None and array.shape == (3,) and np.all(np.isfinite(array))
    return bool(good and np.any(array != 0))


def flag(value):
    return isinstance(value, bool | np.bool_)


def instance(kind):
    return lambda value: isinstance(value, kind)


def schedule(shape):
    return lambda value: (
        isinstance(value, rx.AbstractSchedule) and jnp.shape(value(jnp.asarray(0.5))) == shape
    )


def numbers(value):
    array = real_array(value)
    return array is not None and bool(np.all(np.isfinite(array)))


def perhaps_a_function(value):
    return None if callable(value) and not inspect.isclass(value) else False


def original(*good):
    """Only these very objects make sense."""
    return lambda value: any(value is one for one in good)


def rising(value):
    array = real_array(value)
    good = array is not None and array.shape == (3,) and np.all(np.isfinite(array))
    return bool(good and np.all(np.diff(array) > 0))


def rows(value):
    array = real_array(value)
    good = array is not None and array.ndim >= 1 and array.shape[0] == 3
    return bool(good and np.all(np.isfinite(array)))


def property_of(low, strict, may_lack):
    """A number, one an element, or a function of arc length."""

    def oracle(value):
        if callable(value) and not inspect.isclass(value):
            return None
        number = array_of((), low, strict=strict, optional=may_lack)(value)
        return array_of((N,), low, strict=strict)(value) if number is False else number

    return oracle


def triple_of(low, strict, may_lack):
    def oracle(value):
        if value is None:
            return may_lack
        if isinstance(value, list | tuple) and any(callable(part) for part in value):
            return None
        three = array_of((3,), low, strict=strict)(value)
        return array_of((N, 3), low, strict=strict)(value) if three is False else three

    return oracle


def jumps(value):
    array = real_array(value)
    inside = array is not None and array.ndim == 1 and np.all((array > 0) & (array < 1))
    return bool(inside and np.all(np.diff(np.sort(array)) > 0) and len(array) < N)


# Constructors: what builds, and of every argument a valid value and its oracle


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
            "length": (1.0, lambda v: positive(v) and (None if np.max(v) > 1e3 else True)),
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
            "parameters": (1.0, lambda v: True),
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


def one_precision(oracle):
    """A rod in double precision may refuse single precision."""

    def judged(value):
        single = getattr(value, "dtype", None) == np.float32
        return oracle(value) and (None if single else oracle(value))

    return judged


BUILD, FIELDS = CATALOGUE["Rod"]
CATALOGUE["Rod"] = (BUILD, {k: (v, one_precision(oracle)) for k, (v, oracle) in FIELDS.items()})


def frames(value):
    return array_of((N + 1, 4))(value) is not False


def replacements(value, draw):
    """What may stand in an argument's place."""
    array = real_array(value)
    shape = () if array is None else array.shape
    some = np.zeros(shape) if array is None else np.array(array, float)
    spoilt = some.copy()
    if spoilt.size:
        spoilt.flat[draw.integers(spoilt.size)] = draw.choice([np.nan, np.inf, -np.inf])
    return [
        np.nan, np.inf, -np.inf, 0.0, -1.0, -0.0, 1, 3, -3, 3.0, 3.7, 0.3, 10**12, 10**30, 10**400,
        -(10**12), 1e300, 1e-310, np.float32(0.5), np.float16(0.5), np.int8(3), np.uint8(3),
        np.asarray(0.4), jnp.asarray(0.4), jnp.asarray(3), 1 + 1j, np.complex64(1), True, False,
        np.True_, "abc", "1.5", "", b"x", None, {}, {"a": 1.0}, {1.0}, object(), Ellipsis, int,
        rx.Clamped, rx.Constant, rx.Section, lambda *a: a[0], lambda *a: None, lambda: 1.0, np.sin,
        ONE, THREE, TURN, rx.Free(), rx.Slider((1, 0, 0)), rx.Gravity((0, 0, 1)), ROD, SECTION,
        rx.Penalty(1e6), rx.GeneralizedAlpha(), [], (), [[]], [1.0], [1.0, 2.0], [0.0, 1.0, 2.0],
        (0.0, 0.0, 0.0), [1.0, None], [1.0, "a"], [True, False, True], [1.0, [2.0]], range(3),
        iter([1.0]), np.asarray(["a", "b", "c"]), np.asarray([None] * 3), np.ones(3, bool),
        np.ones(3, complex), np.full(N, 0.5), np.full((N, 3), 0.5), np.ones((N, 1)),
        np.ones((3, N)), np.ones(N + 3), np.ones((2, 2)), np.ones((N + 1, 3)), np.ones((N + 1, 4)),
        np.zeros((N + 1, 3)), np.ones((0, 3)), np.asarray([0.5]), spoilt, -np.abs(some) - 1,
        some.tolist(), some.astype(np.float32), jnp.asarray(some), some.T, some + 0.1,
    ]  # fmt: skip


OURS = re.compile(r"^[a-z_0-9\[\]., ]+(\(.*\))?: ")


def judge(name, argument, value, oracle, build, arguments):
    """What is wrong with the answer, or None."""
    expected = oracle(value)
    label = f"{name}({argument}={value!r:.80})"
    try:
        build(**{**arguments, argument: value})
    except ValueError as error:
        message = str(error)
        if expected is True:
            return f"{label}: refused: {message[:200]}"
        if not OURS.match(message) or (expected is False and argument not in message):
            return f"{label}: unclear: {message[:200]}"
    except Exception as error:
        return f"{label}: unclear {type(error).__name__}: {str(error)[:200]}"
    else:
        if expected is False:
            return f"{label}: taken"
    return None


def constructions(seed, number):
    """Faults found in so many constructions at random."""
    draw = np.random.default_rng(seed)
    faults, names = [], list(CATALOGUE)
    for i in range(number):
        name = names[i % len(names)]
        build, parts = CATALOGUE[name]
        arguments = {part: valid for part, (valid, _) in parts.items()}
        argument = list(parts)[draw.integers(len(parts))]
        choices = replacements(arguments[argument], draw)
        value = choices[draw.integers(len(choices))]
        fault = judge(name, argument, value, parts[argument][1], build, arguments)
        if fault is not None:
            faults.append(fault)
    return faults


# words of equinox and jax that come before our error, which must still come
@pytest.mark.filterwarnings("ignore:A JAX array is being set as static:UserWarning")
@pytest.mark.filterwarnings("ignore:Python iterable type:DeprecationWarning")
@pytest.mark.filterwarnings("ignore::rodjax.results.ModelWarning")
@pytest.mark.parametrize(
    ("seed", "number"), [(0, 200), pytest.param(1, 3000, marks=pytest.mark.slow)]
)
def test_nothing_nonsensical_is_taken_and_nothing_refused_unclearly(seed, number):
    faults = constructions(seed, number)
    assert not faults, "\n".join(faults)


def test_valid_arguments_are_taken():
    for build, parts in CATALOGUE.values():
        build(**{part: valid for part, (valid, _) in parts.items()})


@pytest.mark.filterwarnings("ignore::rodjax.results.ModelWarning")
def test_traced_arguments_are_taken_or_refused_by_name():
    """Numbers and vectors may be traced; counts and flags, which make the program, may not."""
    fixed = {"elements", "rotary_inertia", "extensible", "stress_free", "follower", "jumps"}
    for name, (build, parts) in CATALOGUE.items():
        if name == "start":
            continue  # computes
        arguments = {part: valid for part, (valid, _) in parts.items()}
        for argument, valid in arguments.items():
            if real_array(valid) is None or argument in ("parameters", "loads"):
                continue
            trial = lambda x, a=argument, b=build, k=arguments: jax.tree.leaves(b(**{**k, a: x}))[0]
            stand_in = jnp.asarray(valid)
            if argument in fixed:
                with pytest.raises(ValueError, match=rf"^{argument}: "):
                    jax.eval_shape(trial, stand_in)
            else:
                jax.eval_shape(trial, stand_in)


# Runs


def log_uniform(draw, low, high):
    return float(np.exp(draw.uniform(np.log(low), np.log(high))))


def random_scene(draw, kind):
    """A valid scene of one of few programs, with numbers over wide ranges."""
    vector = lambda size: tuple(size * draw.normal(size=3))
    thickness, length = log_uniform(draw, 1e-4, 0.05), 1.0
    section = rx.circular_section(
        thickness, log_uniform(draw, 1e4, 1e10), log_uniform(draw, 1e4, 1e10), 1e3
    )
    rod = rx.straight_rod(length, N, section, direction=vector(1.0), natural_curvature=vector(1.0))
    ramp = [0.0, log_uniform(draw, 1e-3, 1.0), 2.0]
    along = np.asarray(rod.position[-1] - rod.position[0])
    shift = rx.Smooth(ramp, np.outer([0, 1, 1], vector(0.05)))
    turn = rx.Turn(along, rx.Smooth(ramp, [0.0, draw.normal(), 0.0]))
    weight = rx.Gravity(vector(log_uniform(draw, 1e-3, 1e2)))
    drag = rx.MorisonDrag(*(log_uniform(draw, 1e-3, 1e3) for _ in range(3)))
    pull = rx.PointLoad(-1, rx.Smooth(ramp, np.outer([0, 1, 0], vector(1e-2))))
    ends, loads = {
        "hung": ((rx.Clamped(), rx.Free()), (weight,)),
        "driven": ((rx.Clamped(shift, turn), rx.Slider(along)), (weight, drag)),
        "pulled": ((rx.Clamped(), rx.Free()), (pull, drag)),
    }[kind]
    return rx.Scene(rod, *ends, loads=loads)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hung", "driven", "pulled"])
def test_short_runs_end_well_or_with_a_code(kind):
    draw = np.random.default_rng(7)
    ended, faults = 0, []
    for i in range(100):
        scene = random_scene(draw, kind)
        try:
            state = rx.start(scene)
            end = log_uniform(draw, 1e-4, 1e-1)
            run = rx.adaptive_rollout(scene, state, end, max_steps=400, throw=False)
        except ValueError as error:
            if not OURS.match(str(error)):
                faults.append(f"{kind} {i}: {error}")
            continue
        if run.result != rx.Result.SUCCESS:
            continue
        ended += 1
        leaves = jax.tree.leaves(run.states)
        if not all(np.all(np.isfinite(leaf)) for leaf in leaves):
            faults.append(f"{kind} {i}: not finite with SUCCESS")
        if abs(float(run.final.time) - end) > 1e-9 * end:
            faults.append(f"{kind} {i}: ended at {run.final.time}, not {end}")
    assert not faults, "\n".join(faults)
    assert ended > 20
