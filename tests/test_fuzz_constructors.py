"""Constructors given anything.

Of every constructor valid arguments are drawn and one is replaced. An oracle of the argument's
kind, written apart from the package, says whether what was put there makes sense: then it must be
taken, else a ValueError must name the argument.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from constructor_catalogue import CATALOGUE, ONE, ROD, SECTION, THREE, TURN
from constructor_oracles import OURS, N, real_array

import rodjax as rx

pytestmark = pytest.mark.usefixtures("unchecked")


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
@pytest.mark.filterwarnings("ignore::rodjax.numerics.results.ModelWarning")
@pytest.mark.parametrize(
    ("seed", "number"), [(0, 200), pytest.param(1, 3000, marks=pytest.mark.slow)]
)
def test_nothing_nonsensical_is_taken_and_nothing_refused_unclearly(seed, number):
    faults = constructions(seed, number)
    assert not faults, "\n".join(faults)


def test_valid_arguments_are_taken():
    for build, parts in CATALOGUE.values():
        build(**{part: valid for part, (valid, _) in parts.items()})


@pytest.mark.filterwarnings("ignore::rodjax.numerics.results.ModelWarning")
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
