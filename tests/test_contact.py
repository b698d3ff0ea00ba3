"""Self-contact: the division of the rod, pair forces, and what is refused."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIAMETER, LAWS, PAIR, hairpin, order_of

from rodjax import measures
from rodjax.constraints.ends import Clamped
from rodjax.dynamics.consistency import start
from rodjax.dynamics.run import Run
from rodjax.dynamics.stepping import no_info, step
from rodjax.interactions import contact_forces, contact_report, pair_points
from rodjax.interactions import contact_laws as laws
from rodjax.interactions import sites as sites_module
from rodjax.interactions.contact import Contact
from rodjax.interactions.contact_law import continued
from rodjax.interactions.loads import MorisonDrag
from rodjax.rods.builders import straight_rod
from rodjax.rods.section import circular_section
from rodjax.rods.state import node_motion
from rodjax.scenes.scene import Scene

# Forces


@pytest.mark.slow
def test_straight_rod_has_no_contact_and_its_step_is_that_without():
    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    rod = straight_rod(1.0, 10, section, natural_curvature=(0.3, 0.0, 0.0))
    contact = Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2)
    runs = [
        step(scene, start(scene), jnp.asarray(1e-2))[0]
        for scene in (Scene(rod, Clamped()), Scene(rod, Clamped(), contact=contact))
    ]
    for plain, touching in zip(*(jax.tree.leaves(run) for run in runs), strict=True):
        np.testing.assert_allclose(touching, plain, rtol=1e-9, atol=1e-12)


def test_forces_are_equal_and_opposite(bent):
    scene, state, near = bent
    force = contact_forces.forces(scene.contact, *near, node_motion(state))
    scale = float(jnp.max(jnp.abs(force)))
    assert scale > 0
    np.testing.assert_allclose(jnp.sum(force, 0), 0.0, atol=1e-12 * scale)


def test_central_forces_make_no_torque():
    scene = Scene(
        hairpin(),
        Clamped(),
        Clamped(),
        contact=Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2),
    )
    state = start(scene)
    push = contact_report.report(scene.contact, scene.rod, state.position, state.velocity).force
    torque = jnp.sum(jnp.cross(state.position, push), 0)
    np.testing.assert_allclose(torque, 0.0, atol=1e-12 * float(jnp.max(jnp.abs(push))))


def test_contacts_over_a_run_are_those_of_its_states(bent):
    scene, state, _ = bent
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    apart = states.position.at[1, 13:, 0].add(1.0)  # one strand moved out of reach
    states = eqx.tree_at(lambda s: s.position, states, apart)
    zero = jnp.asarray(0, jnp.int32)
    run = Run(states, no_info(apart.dtype), zero, zero, zero)
    found = measures.contacts(scene, run)
    alone = contact_report.report(scene.contact, scene.rod, state.position, state.velocity)
    np.testing.assert_allclose(found.force[0], alone.force, rtol=1e-12, atol=1e-15)
    assert float(found.total[0]) == pytest.approx(float(alone.total)) and alone.total > 0
    assert float(found.total[1]) == 0 and float(found.smallest[1]) == np.inf
    with pytest.raises(ValueError, match="scene: it has no contact"):
        measures.contacts(dataclasses.replace(scene, contact=None), run)


# Division into segments and points


def test_vertices_lie_on_the_curve_through_the_nodes():
    """Fourth order on a helix, where chords would be off by kappa l^2/8."""

    def helix(s):
        return np.stack([0.1 * np.cos(8 * s), 0.1 * np.sin(8 * s), 0.6 * s], -1)

    section = circular_section(DIAMETER, 1e6, 5e5, 1500.0)
    errors, counts = [], (12, 24, 48)
    for elements in counts:
        rod = straight_rod(1.0, elements, section)
        contact = Contact(LAWS["damped"], segments=50, cutoff=0.1, points_per_segment=2)
        where = sites_module.sites_of(contact, rod)
        vertices = sites_module.interpolate(where, jnp.asarray(helix(np.asarray(rod.arc_length))))
        exact = helix(np.linspace(0, 1, 51))
        errors.append(np.max(np.linalg.norm(np.asarray(vertices) - exact, axis=1)))
        np.testing.assert_allclose(jnp.sum(where.weight, 1), 1.0, atol=1e-13)
        # forces are spread with the same total and moment
        force = jnp.asarray(np.random.default_rng(0).normal(size=vertices.shape))
        nodes = helix(np.asarray(rod.arc_length))
        nodal = np.asarray(sites_module.spread(where, force, elements + 1))
        np.testing.assert_allclose(nodal.sum(0), force.sum(0), atol=1e-12)
        moment = np.cross(vertices, force).sum(0)
        np.testing.assert_allclose(np.cross(nodes, nodal).sum(0), moment, atol=1e-12)
    assert order_of(1 / np.asarray(counts), errors) > 3.5


# where strands settle under each law
SETTLED = {
    "damped": 0.58 * DIAMETER,
    "inverse_power": DIAMETER,
    "lennard_jones": 0.026,
    "debye_hueckel": DIAMETER,
    "barrier": 1.05 * DIAMETER,
    "penalty": 0.99 * DIAMETER,
    "damped_penalty": 0.99 * DIAMETER,
}


@pytest.mark.parametrize("name", LAWS)
def test_ripple_of_the_force_is_under_two_percent(name):
    """Sliding one strand along the other by one spacing barely changes the force.

    Two parallel strands at a distance d feel sum_j psi(d_j) window n_j per point; its ripple with
    the phase between the points is that of the documented spacing h = min(sqrt(2 d w)/2, d/3).
    """
    law = LAWS[name]
    d = SETTLED[name]
    psi = lambda r: continued(law, r, jnp.asarray(0.0), PAIR)
    width = float(psi(jnp.asarray(d)) / abs(jax.grad(psi)(jnp.asarray(d))))
    spacing = min(0.5 * np.sqrt(2 * d * width), d / 3)
    contact = Contact(law, 2, cutoff=6 * DIAMETER)
    phase = spacing * np.linspace(0, 1, 17)[:, None] + spacing * np.arange(-40, 41)
    r = jnp.asarray(np.sqrt(d**2 + phase**2))
    cosine = jnp.asarray(phase) / r
    density = jax.vmap(jax.vmap(psi))(r) * pair_points.window(contact, r, PAIR, (cosine, cosine))
    force = np.sum(density * d / r, 1) * spacing
    assert np.ptp(force) < 0.02 * np.mean(force)


@pytest.mark.slow
def test_force_does_not_depend_on_the_division():
    totals = []
    for segments, points in ((48, 4), (96, 2), (96, 6)):
        contact = Contact(
            LAWS["damped"], segments, 0.1, points_per_segment=points, pairs_per_segment=12
        )
        scene = Scene(hairpin(96), contact=contact)
        state = start(scene)
        found = contact_report.report(scene.contact, scene.rod, state.position, state.velocity)
        totals.append(float(found.total))
    assert totals[0] > 0
    np.testing.assert_allclose(totals, totals[0], rtol=0.01)


# Bad input, and traced values


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"cutoff": -1.0}, "cutoff"),
        ({"cutoff": 0.1, "aperture": 4.0}, "aperture"),
        ({"cutoff": 0.1, "exclusion": 0.05}, "cutoff"),
        ({"cutoff": 0.1, "segments": 1}, "segments"),
        ({"cutoff": 0.1, "points_per_segment": 0}, "points_per_segment"),
        ({"cutoff": 0.1, "edge": 0.0}, "edge"),
        ({"cutoff": 0.1, "capacities": (8, 4)}, "capacities"),
    ],
)
def test_bad_input_names_the_argument(arguments, name):
    with pytest.raises(ValueError, match=f"^{name}"):
        Contact(LAWS["damped"], **({"segments": 20} | arguments))


def test_scenes_are_built_in_traced_code_from_known_and_traced_values():
    """There even known arrays become traced by an operation, so no check may use one."""
    scene = Scene(hairpin(), loads=(MorisonDrag(1.0, 1.0, 1.0),))

    @jax.jit
    def build(factor):
        rod = dataclasses.replace(scene.rod, mass=factor * scene.rod.mass)
        drag = dataclasses.replace(scene.loads[0], normal_coefficient=factor)
        law = dataclasses.replace(LAWS["damped"], k1=factor)
        new = Scene(rod, Clamped(), loads=(drag,), contact=Contact(law, 20, cutoff=0.1))
        return new.contact.law.k1

    assert float(build(2.0)) == 2.0


def test_contact_needs_a_diameter_and_room():
    rod = hairpin()
    bare = dataclasses.replace(rod, diameter=None)
    with pytest.raises(ValueError, match="^diameter"):
        Scene(bare, contact=Contact(LAWS["damped"], segments=20, cutoff=0.1, points_per_segment=2))
    with pytest.raises(ValueError, match="^cutoff"):
        Scene(rod, contact=Contact(LAWS["damped"], 20, cutoff=0.9))
    with pytest.raises(ValueError, match="^k1"):
        laws.DampedInversePower(k1=-1.0, k3=0.0, reference_spacing=1.0)
