"""The rod as a differential equation: an exact solution, and the library's own steps."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import final_state, order_of, slow

from rodjax import semidiscrete
from rodjax.constraints.ends import Clamped, Free, Slider, Switched, Turn
from rodjax.dynamics.consistency import start
from rodjax.equations.generalized_alpha import GeneralizedAlpha
from rodjax.inputs.schedules import Function
from rodjax.interactions.loads import Gravity, MorisonDrag
from rodjax.numerics.rotations import exponential, logarithm
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import Section, circular_section
from rodjax.scenes.scene import Scene

SECTION = Section(
    stiffness=(1.0, 1.3, 0.8),
    mass=1.0,
    rotary_inertia=(0.02, 0.02, 0.04),
    compliance=(0.01, 0.01, 0.005),
    diameter=0.1,
    area=8e-3,
)


def solve(scene, y0, stop, solver=None, tolerance=1e-11, times=None):
    """The motion at `stop` (or at the times) by an explicit solver with its step controller."""
    saved = diffrax.SaveAt(t1=True) if times is None else diffrax.SaveAt(ts=times)
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(semidiscrete.vector_field),
        diffrax.Dopri8() if solver is None else solver,
        0.0,
        stop,
        1e-4,
        y0,
        args=scene,
        saveat=saved,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=100_000,
    )
    last = (lambda leaf: leaf[0]) if times is None else (lambda leaf: leaf)
    return jax.tree.map(last, found.ys)


def cantilever():
    """Released straight under gravity, naturally curved: bending, twist, shear and stretch."""
    rod = straight_rod(1.0, 6, SECTION, natural_curvature=(0.3, 0.1, 0.2))
    return Scene(rod, Clamped(), Free(), (Gravity((0.0, -3.0, 2.0)),))


def driven():
    """A clamp that moves and turns, a slider, drag with added mass."""
    shift = Function(lambda t: jnp.sin(1.5 * t) ** 4 * jnp.asarray([0.4, -0.2, 0.8]))
    turn = Turn((0.0, 0.0, 1.0), Function(lambda t: 2 * jnp.sin(1.5 * t) ** 4))
    rod = straight_rod(1.0, 6, SECTION, natural_curvature=(0.3, 0.1, 0.0))
    loads = (MorisonDrag(50.0, 0.5, 0.1, added_mass_coefficient=1.0),)
    return Scene(rod, Clamped(shift, turn), Slider((0.0, 0.3, 1.0)), loads)


@pytest.mark.slow
@pytest.mark.parametrize("make", [cantilever, slow(driven)])
def test_steps_converge_to_the_differential_equation(make):
    scene = make()
    state, stop = start(scene), 0.3
    exact = solve(scene, semidiscrete.initial_value(scene, state), stop)
    counts = np.array([400, 800, 1600])
    method = GeneralizedAlpha(0.8, tolerance=1e-12)
    finals = [final_state(scene, state, stop, count, method) for count in counts]
    force = semidiscrete.internal_force(scene.rod, exact)
    found = {
        "position": [jnp.max(jnp.abs(s.position - exact.position)) for s in finals],
        "rate": [jnp.max(jnp.abs(s.rate - exact.rate)) for s in finals],
        "force": [jnp.max(jnp.abs(s.force - force)) for s in finals],
    }
    for name, errors in found.items():
        assert order_of(1 / counts, errors) == pytest.approx(2.0, abs=0.15), (name, errors)
    moved = float(jnp.max(jnp.abs(exact.position - state.position)))
    assert moved > 0.01 and found["position"][-1] < 1e-4 * moved


@pytest.mark.slow
def test_a_twisted_shaft_swings_at_the_frequency_of_its_grid():
    """theta_i = sin(pi i / 2n) cos(omega t), omega = (2/ds) sqrt(C/I3) sin(pi/4n), at any size."""
    n = 8
    rod = straight_rod(1.0, n, SECTION)
    scene = Scene(rod, Clamped())
    shape = np.sin(np.pi * np.arange(n + 1) / (2 * n))
    frames = exponential(jnp.asarray(1.5 * shape[:, None] * np.array([0.0, 0.0, 1.0])))
    y0 = semidiscrete.initial_value(scene, start(scene, quaternion=frames))
    omega = 2 * n * np.sqrt(0.8 / 0.04) * np.sin(np.pi / (4 * n))
    times = np.linspace(0, 2 * np.pi / omega, 9)
    found = solve(scene, y0, times[-1], tolerance=1e-12, times=times)
    angle = np.asarray(logarithm(found.quaternion))
    expected = 1.5 * np.cos(omega * times)[:, None] * shape
    np.testing.assert_allclose(angle[..., 2], expected, atol=1e-9)
    np.testing.assert_allclose(
        found.position, np.broadcast_to(rod.position, (9, n + 1, 3)), atol=1e-12
    )


@pytest.mark.slow
def test_a_stiff_solver_finds_the_same():
    scene = cantilever()
    y0 = semidiscrete.initial_value(scene)
    explicit = solve(scene, y0, 0.1)
    implicit = solve(scene, y0, 0.1, diffrax.Kvaerno5(), 1e-8)
    np.testing.assert_allclose(implicit.position, explicit.position, atol=1e-6)
    np.testing.assert_allclose(implicit.rate, explicit.rate, atol=1e-4)


def test_what_is_no_differential_equation_is_refused():
    circular = lambda **options: straight_rod(
        1.0, 4, circular_section(0.1, 1.0, 1.0, 1.0, **options)
    )
    with pytest.raises(ValueError, match=r"^compliance: .*extensible=True"):
        semidiscrete.initial_value(Scene(circular(), Clamped()))
    with pytest.raises(ValueError, match=r"^rotary_inertia: "):
        thin = circular(extensible=True, rotary_inertia=False)
        semidiscrete.initial_value(Scene(thin, Clamped()))
    good = circular(extensible=True)
    with pytest.raises(ValueError, match=r"^compliance: "):
        stiff = dataclasses.replace(good, compliance=good.compliance.at[:, 2].set(0.0))
        semidiscrete.initial_value(Scene(stiff, Clamped()))
    with pytest.raises(ValueError, match=r"^first_end, last_end: .*impulse"):
        semidiscrete.initial_value(Scene(good, Clamped(), Switched(Free(), Clamped(), 1.0)))
