"""`rx.jit`: the compiler options reach XLA, results agree with `jax.jit`, other backends none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, relative_difference

import rodjax as rx
from rodjax.numerics import compilation


@pytest.fixture(autouse=True)
def _fresh_options():
    compilation._options.cache_clear()
    yield
    compilation._options.cache_clear()


def _energy(stiffness, scene):
    rod = rx.straight_rod(1.0, 8, UNIT_SECTION, natural_curvature=(0.3, 0.1, 0.0))
    density = rx.energy.strain_energy_density(rod, scene["state"])
    return stiffness * jnp.sum(density) + scene["offset"]


def _arguments():
    rod = rx.straight_rod(1.0, 8, UNIT_SECTION, natural_curvature=(0.3, 0.1, 0.0))
    state = rx.start(rx.Scene(rod, rx.Clamped()))
    return jnp.asarray(2.0), {"state": state, "offset": 1.5, "name": "a string is no array"}


def test_results_agree_with_those_without_options():
    stiffness, rest = _arguments()
    expected = _energy(stiffness, rest)
    np.testing.assert_allclose(rx.jit(_energy)(stiffness, rest), expected, rtol=1e-14)
    slope = rx.jit(jax.grad(_energy))(stiffness, rest)
    np.testing.assert_allclose(slope, (expected - 1.5) / 2.0, rtol=1e-14)
    # Eq. (4) of the straight rod: B kappa0^2 / 2 on every one of the 8 elements
    density = 0.5 * (1.0 * 0.3**2 + 1.3 * 0.1**2)
    np.testing.assert_allclose(expected, 2.0 * 8 * density + 1.5, rtol=1e-12)


def test_program_inside_traced_code_and_as_decorator():
    @rx.jit
    def square(x):
        """Its own docstring."""
        return x**2

    assert square.__doc__ == "Its own docstring."
    x = jnp.linspace(0.0, 1.0, 5)
    np.testing.assert_array_equal(jax.jit(lambda x: square(x) + 1)(x), x**2 + 1)
    np.testing.assert_array_equal(jax.vmap(jax.grad(square))(x), 2 * x)


def test_options_reach_the_compiler(monkeypatch):
    # an option that no backend knows is refused by the compiler: so it has seen it
    monkeypatch.setattr(compilation, "_options", lambda: {"xla_no_such_option": True})
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
        rx.jit(lambda x: x + 2)(jnp.zeros(3))
    assert float(jax.jit(rx.jit(lambda x: x + 2))(jnp.zeros(()))) == 2.0  # inside: without


def test_unknown_options_are_left_out(monkeypatch):
    known = dict(compilation._options())
    options = {**compilation._OPTIONS, "xla_no_such_option": True}
    monkeypatch.setattr(compilation, "_OPTIONS", options)
    compilation._options.cache_clear()
    assert compilation._options() == known
    assert "xla_disable_hlo_passes" in known


def test_other_backends_get_no_options(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compilation._options() == {}
    x = jnp.arange(3.0)
    assert relative_difference(rx.jit(lambda x: x * 3)(x), 3 * x) == 0
