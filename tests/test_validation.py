"""The checks that constructors share: what each lets pass, and what it says."""

from collections import OrderedDict

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx
from rodjax.inputs import validation
from rodjax.inputs.validation import (
    as_float,
    as_float_or_none,
    as_integer,
    as_traced,
    check_finite,
    check_flag,
    check_instance,
    check_integer,
    check_not_negative,
    check_numbers,
    check_positive,
    check_scalar,
    check_shape,
    given,
    known,
)

NONSENSE = {
    "string": "abc",
    "digits": "1.5",
    "bytes": b"x",
    "complex": 1 + 1j,
    "complex array": jnp.ones(2, complex),
    "boolean": True,
    "booleans": np.ones(2, bool),
    "none": None,
    "dictionary": {"a": 1.0},
    "object": object(),
    "function": lambda t: t,
    "class": rx.Clamped,
    "module": rx.Clamped(),
    "ragged": [1.0, [2.0]],
    "strings": ["a", "b"],
    "objects": np.asarray([None, 1.0]),
    "set": {1.0, 2.0},
    "hole": [1.0, None],
    "beyond all floats": 10**400,
}


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_is_left_by_converters_and_refused_by_checks(name):
    value = NONSENSE[name]
    assert as_float(value) is value
    assert as_integer(value) is value
    for check in (check_numbers, check_scalar, check_finite, check_positive, check_not_negative):
        with pytest.raises(ValueError, match=r"^width: must be .* got "):
            check(width=value)
    with pytest.raises(ValueError, match=r"^width: must be three real numbers, got "):
        check_shape((3,), width=value)
    with pytest.raises(ValueError, match=r"^width: must be a whole number of at least 2 "):
        check_integer(2, width=value)


@pytest.mark.parametrize(
    "value",
    [3, -3, 2.5, np.int8(3), np.float16(2), np.longdouble(2), 10**30, [1, 2.5], jnp.bfloat16(2)],
    ids=str,
)
def test_real_numbers_become_floats(value):
    found = as_float(value)
    assert found.dtype == jnp.float64
    np.testing.assert_array_equal(np.asarray(found), np.asarray(value, float))
    check_numbers(width=value)


class Foreign:
    """Another library's array, which numpy may read or not."""

    dtype, shape = "torch.float32", (2,)

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        if self.values is None:
            raise RuntimeError("cannot be read while it takes part in a gradient")
        return np.asarray(self.values, dtype)


def test_arrays_of_other_libraries():
    np.testing.assert_array_equal(as_float(Foreign([1.0, 2.0])), [1.0, 2.0])
    check_shape((2,), width=Foreign([1.0, 2.0]))
    for value in (Foreign(None), [Foreign(None)], Foreign(["a", "b"])):
        assert as_float(value) is value and as_integer(value) is value
        with pytest.raises(ValueError, match=r"^width: must be a real number or an array of them"):
            check_numbers(width=value)


def test_a_traced_number_beside_a_text():
    def build(x):
        value = [x, "a"]
        assert as_float(value) is value
        check_numbers(width=value)

    with pytest.raises(ValueError, match=r"^width: must be a real number or an array of them"):
        jax.jit(build)(1.0)


def test_whole_numbers_stay_whole_where_the_integers_hold_them():
    found = as_traced({"a": 2**40, "b": 2**70, "c": 10**400})
    assert found["a"].dtype == jnp.int64 and int(found["a"]) == 2**40
    assert float(found["b"]) == 2.0**70 and np.isinf(found["c"])
    with jax.enable_x64(False):
        assert as_traced(2**31 - 1).dtype == jnp.int32
        assert float(as_traced(2**40)) == 2.0**40


def test_single_precision_is_kept():
    assert as_float(np.ones(2, np.float32)).dtype == jnp.float32
    with jax.enable_x64(False):
        assert as_float(np.ones(2, np.float32)).dtype == jnp.float32
        assert as_float(1.0).dtype == jnp.float32
    assert as_float_or_none(None) is None and as_float_or_none(2) == 2.0


def test_whole_numbers():
    for value in (3, 3.0, np.int64(3), np.float32(3.0), jnp.asarray(3), np.asarray(3.0)):
        assert type(as_integer(value)) is int and as_integer(value) == 3
    for value in (3.5, np.nan, np.inf, np.ones(2), [3]):
        assert as_integer(value) is value
        with pytest.raises(ValueError, match=r"^count: must be a whole number"):
            check_integer(1, count=value)
    check_integer(1, count=3)
    for value in (0, 11, 10**30, -(10**30)):
        with pytest.raises(ValueError, match=rf"at least 1 and at most 10, got {value}$"):
            check_integer(1, 10, count=value)
    with pytest.raises(ValueError, match="at most 1000000"):
        check_integer(1, count=validation.LARGEST + 1)


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (check_finite, [-1.0, 0.0, 1e300], [np.nan, np.inf, -np.inf]),
        (check_positive, [1e-300, 1.0, 7], [0.0, -1.0, np.nan, np.inf, 0]),
        (check_not_negative, [0.0, 1e300, 0], [-1e-300, np.nan, np.inf, -np.inf]),
    ],
)
def test_checks_of_values(check, good, bad):
    for value in good:
        check(width=value, height=[value, value], depth=jnp.asarray([[value]]))
    for value in bad:
        with pytest.raises(ValueError, match=rf"^width: must be .*, got {value}$"):
            check(width=value)
        with pytest.raises(ValueError, match=rf"^width: .*, got {float(value)} at index 1$"):
            check(height=1.0, width=jnp.asarray([1.0, value, 1.0]))
        with pytest.raises(ValueError, match=rf"^width: .*, got {float(value)} at index \(1, 0\)$"):
            check(width=np.asarray([[1.0, 1.0], [value, 1.0]]))


@pytest.mark.parametrize("check", [check_finite, check_positive, check_not_negative])
def test_whole_numbers_of_any_size_are_numbers(check):
    check(width=10**30)
    if check is not check_finite:
        with pytest.raises(ValueError, match=r"^width: must be .*, got -1e\+30$"):
            check(width=-(10**30))
    with pytest.raises(ValueError, match="^width: must be a real number"):
        check(width=10**400)


def test_shapes():
    check_scalar(a=1.0, b=jnp.ones(()), c=np.float32(1))
    check_shape((3,), a=[1, 2, 3], b=jnp.ones(3))
    check_shape((4, 3), a=np.ones((4, 3)))
    with pytest.raises(ValueError, match=r"^b: must be one real number, got shape \(1,\)$"):
        check_scalar(a=1.0, b=[1.0])
    with pytest.raises(ValueError, match=r"^g: must be three real numbers, got 9.81$"):
        check_shape((3,), g=9.81)
    with pytest.raises(ValueError, match=r"^g: must be an array of shape \(4, 3\) .* \(3, 4\)$"):
        check_shape((4, 3), g=np.ones((3, 4)))


def test_flags():
    check_flag(a=True, b=np.bool_(False))
    for value in (1, 0.0, "yes", None, (1.0, 1.0, 2.0), lambda: None, np.asarray([True])):
        with pytest.raises(ValueError, match="^b: must be True or False, got "):
            check_flag(a=True, b=value)


def test_instances():
    mend = "give an end such as Clamped()"
    check_instance(rx.AbstractEnd, mend, first=rx.Free(), last=rx.Slider((0, 0, 1)))
    with pytest.raises(ValueError, match=r"^last: Clamped is a class; .* Clamped\(...\)$"):
        check_instance(rx.AbstractEnd, mend, first=rx.Free(), last=rx.Clamped)
    ends = ("class", "module")
    others = [value for name, value in NONSENSE.items() if name not in ends]
    for value in (*others, rx.Constant(1.0), OrderedDict):
        with pytest.raises(ValueError, match=r"^last: give an end such as Clamped\(\); got "):
            check_instance(rx.AbstractEnd, mend, last=value)


def test_what_is_traced_is_checked_by_shape_and_kind():
    seen = []

    def body(x, v, flag):
        for check in (check_finite, check_positive, check_not_negative, check_numbers):
            check(width=x, all=[x, x], speed=v)
        check_scalar(width=x)
        check_shape((3,), speed=v)
        with pytest.raises(ValueError, match=r"^speed: must be one real number, got shape \(3,\)"):
            check_scalar(speed=v)
        with pytest.raises(ValueError, match=r"^flag: .*, got (a traced bool|True)"):
            check_finite(flag=flag)
        with pytest.raises(ValueError, match=r"^width: must be a whole number"):
            check_integer(1, width=as_integer(x))
        assert not known(x) and known(np.ones(2))
        # in traced code as well a number that is known is checked
        with pytest.raises(ValueError, match=r"^size: must be positive"):
            check_positive(size=-1.0)
        seen.append(as_float(x))
        return x

    x, v, flag = jnp.asarray(-1.0), jnp.ones(3), jnp.asarray(True)
    jax.jit(body)(x, v, flag)
    jax.grad(lambda x: body(x, v, flag))(x)
    jax.vmap(body)(x[None], v[None], flag[None])
    assert len(seen) == 3


def test_stand_ins_of_arrays_pass():
    stand_in = jax.ShapeDtypeStruct((3,), jnp.float64)
    assert as_float(stand_in) is stand_in and not known(stand_in)
    check_shape((3,), a=stand_in)
    check_positive(a=stand_in)
    with pytest.raises(ValueError, match=r"^a: must be one real number, got shape \(3,\)"):
        check_scalar(a=stand_in)
    with pytest.raises(ValueError, match=r"^a: must be a real number"):
        check_positive(a=jax.ShapeDtypeStruct((), jnp.bool_))


def test_transformations_never_meet_the_checks():
    method = rx.GeneralizedAlpha(0.3, 1e-9)
    for stand_in in (None, True, object()):
        other = jax.tree.map(lambda _, s=stand_in: s, method)
        assert other.spectral_radius is stand_in
    rows = jax.vmap(rx.GeneralizedAlpha)(jnp.asarray([0.1, 0.2]))
    assert rows.spectral_radius.shape == (2,)


def test_given_leaves_out_what_is_none():
    assert given(a=None, b=0.0, c=False) == {"b": 0.0, "c": False}
