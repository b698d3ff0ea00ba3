"""Transforms between bounded parameters and their unknowns, and the vector of a pytree of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rodjax.fitting.bounds import Interval, Positive, Unbounded, unknowns_of


def finite(size):
    return st.floats(-size, size, allow_nan=False)


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_round_trips(data):
    """Parameter to unknown and back, and the other way; all unknowns give allowed parameters."""
    low = data.draw(finite(1e3))
    bounds = (
        Unbounded(data.draw(st.floats(1e-6, 1e6))),
        Positive(),
        Interval(low, low + data.draw(st.floats(1e-2, 1e3))),
    )
    bound = data.draw(st.sampled_from(bounds))
    unknown = jnp.asarray(data.draw(finite(1.5)))
    value = bound.to_bounded(unknown)
    assert bound.inside(value)
    assert bound.to_unbounded(value) == pytest.approx(float(unknown), rel=1e-6, abs=1e-6)
    again = bound.to_bounded(bound.to_unbounded(value))
    assert again == pytest.approx(float(value), rel=1e-12, abs=1e-9)
    assert jax.grad(bound.to_bounded)(unknown) > 0


def test_units_of_the_unknowns():
    """The scale; a relative change; the width of the interval in its middle."""
    assert Unbounded(4.0).to_bounded(jnp.asarray(0.5)) == 2
    positive = Positive()
    change = positive.to_unbounded(jnp.asarray(6.0)) - positive.to_unbounded(jnp.asarray(3.0))
    assert change == pytest.approx(np.log(2), rel=1e-14)
    interval = Interval(-2.0, 8.0)
    assert interval.to_bounded(jnp.asarray(0.0)) == 3
    assert jax.grad(interval.to_bounded)(0.0) == pytest.approx(10, rel=1e-14)


def test_interval_for_each_element_and_at_its_ends():
    interval = Interval(jnp.array([0.0, -1.0]), jnp.array([1.0, 5.0]))
    far = interval.to_bounded(jnp.array([-30.0, 30.0]))
    np.testing.assert_allclose(far, [0.0, 5.0], atol=1e-15)
    np.testing.assert_array_equal(interval.at_bound(jnp.array([-30.0, 0.1])), [True, False])
    assert not Positive().at_bound(jnp.asarray(-30.0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Unbounded(0.0), "scale: must be positive"),
        (lambda: Unbounded(np.nan), "scale: must be positive"),
        (lambda: Interval(1.0, 1.0), "low < high"),
        (lambda: Interval(0.0, np.inf), "must be finite"),
        (lambda: Interval(0.0, jnp.array([1.0, -1.0])), "low < high"),
    ],
)
def test_bad_bounds(make, message):
    with pytest.raises(ValueError, match=message):
        make()


class Law(eqx.Module):
    strength: jax.Array
    power: jax.Array
    nothing: None = None


GUESS = {"law": Law(jnp.array([2.0, 0.5]), jnp.asarray(3.0)), "drag": [0.1, np.zeros((1, 2))]}


def test_unknowns_of_a_pytree():
    """Bounds of branches reach their leaves; None scales by the size of the guess."""
    bounds = {"law": Law(Positive(), Interval(0.0, 4.0)), "drag": None}
    unknowns = unknowns_of(GUESS, bounds)
    assert unknowns.names == (
        "drag.0",
        "drag.1[0, 0]",
        "drag.1[0, 1]",
        "law.strength[0]",
        "law.strength[1]",
        "law.power",
    )
    assert unknowns.labels[0] == "drag.0/0.1"
    assert unknowns.labels[1] == "drag.1[0, 0]"  # a guess of zero has no size
    assert unknowns.labels[3:] == ("log law.strength[0]", "log law.strength[1]", "logit law.power")
    vector = unknowns.vector(unknowns.like)
    expected = [1.0, 0.0, 0.0, np.log(2), np.log(0.5), 0.25 * np.log(3)]
    np.testing.assert_allclose(vector, expected, atol=1e-15)
    again = unknowns.parameters(vector)
    assert jax.tree.structure(again) == jax.tree.structure(unknowns.like)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), again, unknowns.like)
    np.testing.assert_allclose(unknowns.slopes(vector), [0.1, 1, 1, 2, 0.5, 3], rtol=1e-14)
    assert unknowns.at_bound(vector) == ()
    assert unknowns.at_bound(vector.at[5].set(3.0)) == ("law.power",)


def test_one_bound_for_all_and_none():
    assert unknowns_of({"a": 1, "b": np.ones(2)}, Positive()).labels == (
        "log a",
        "log b[0]",
        "log b[1]",
    )
    assert unknowns_of(jnp.array([3.0, -4.0])).labels == ("parameter[0]/4", "parameter[1]/4")


def test_unknowns_pass_through_jit():
    unknowns = unknowns_of(GUESS, {"law": Positive(), "drag": Unbounded()})
    total = eqx.filter_jit(lambda unknowns, u: jnp.sum(unknowns.parameters(u)["law"].strength))
    assert total(unknowns, unknowns.vector(unknowns.like)) == pytest.approx(2.5, rel=1e-14)


@pytest.mark.parametrize(
    ("guess", "bounds", "message"),
    [
        ({"a": 1.0, "b": -2.0}, Positive(), "guess: b is -2, but must be positive"),
        ({"a": 0.0}, Positive(), "guess: a is 0, "),
        ({"a": jnp.array([1.0, 3.0])}, Interval(0, 3), r"a\[1\] is 3, but must be between 0.0 and"),
        ({"a": np.inf}, None, "guess: a is inf, but must be finite"),
        ({"a": 1.0}, {"b": Positive()}, "bounds: not a prefix"),
        ({"a": 1.0}, {"a": 2.0}, "bounds: expected bounds or None, got 2.0"),
        ({}, None, "guess: it holds no parameter"),
    ],
)
def test_bad_guesses(guess, bounds, message):
    with pytest.raises(ValueError, match=message):
        unknowns_of(guess, bounds)
