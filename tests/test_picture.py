"""Pictures by name: what they show, of one rod and several, of runs that failed or are empty."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.lines
import matplotlib.text
import numpy as np
import pytest
from helpers import UNIT_SECTION, standing_run
from matplotlib.collections import PolyCollection, QuadMesh

import rodjax as rx
from rodjax.dynamics.run import of_no_steps
from rodjax.viewing.maps import between
from rodjax.viewing.picture import _columns, _that_matter

ELEMENTS = 6


@pytest.fixture(scope="module")
def scene():
    """A clamped rod, its other end turned about e3, which is across it."""
    rod = rx.straight_rod(1.0, ELEMENTS, UNIT_SECTION, direction=(1, 0, 0))
    return rx.Scene(rod, rx.Clamped(rotation=rx.Turn((0, 0, 1), rx.Constant(0.0))))


@pytest.fixture(scope="module")
def run(scene):
    """Seven states of which the frames turn by t/2 about the rod over its length."""
    made = standing_run(scene, 6)
    angle = 0.5 * np.asarray(made.times)[:, None] * np.linspace(0, 1, ELEMENTS + 1)[None]
    frames = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], -1)
    frames = rx.rotations.multiply(made.states.quaternion, jnp.asarray(frames))
    return eqx.tree_at(lambda r: r.states.quaternion, made, frames)


@pytest.fixture(scope="module")
def failed(run):
    """The run lost its numbers after the fourth state."""
    lost = lambda leaf: jnp.where(jnp.arange(7)[:, None, None] < 4, leaf, jnp.nan)
    where = lambda r: (r.states.position, r.states.quaternion, r.states.rate, r.result)
    states, code = run.states, jnp.asarray(int(rx.Result.NEWTON_FAILED), jnp.int32)
    new = lost(states.position), lost(states.quaternion), lost(states.rate), code
    return eqx.tree_at(where, run, new)


def words_of(figure):
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text) if text.get_text()]


def drawn(figure, tmp_path):
    """Drawing is what fails, not setting up."""
    figure.savefig(tmp_path / "figure.png", dpi=40)
    return words_of(figure)


def curves_of(figure):
    return {line.get_label(): line for line in figure.findobj(matplotlib.lines.Line2D)[::-1]}


def map_of(figure):
    (mesh,) = figure.findobj(QuadMesh)[:1]
    return mesh


def test_a_map_shows_a_measure_over_arc_length_and_time(scene, run, tmp_path):
    figure = rx.picture(scene, run, "twist")
    words = drawn(figure, tmp_path)
    assert {"arc length s [m]", "time [s]", "twist [rad/m]", "a rod of 6 elements"} <= set(words)
    mesh = map_of(figure)
    expected = np.broadcast_to(0.5 * np.asarray(run.times), (ELEMENTS, 7))
    np.testing.assert_allclose(mesh.get_array(), expected, atol=1e-12)
    assert (mesh.norm.vmin, mesh.norm.vmax) == pytest.approx((-0.3, 0.3))
    corners = mesh.get_coordinates()
    np.testing.assert_allclose(corners[:, 0, 1], np.linspace(0, 1, ELEMENTS + 1), atol=1e-12)
    np.testing.assert_allclose(corners[0, :, 0], np.arange(8) / 10 - 0.05, atol=1e-12)


def test_measures_of_nodes_and_your_own_have_maps_too(scene, run, tmp_path):
    own = np.arange(7 * (ELEMENTS + 1)).reshape(7, -1)
    units = rx.units.Units("mm", "ms")
    options = {"measures": {"rank": own}, "measure_units": {"rank": "places"}, "units": units}
    figure = rx.picture(scene, run, "rank", "speed", title="ranks", **options)
    words = drawn(figure, tmp_path)
    assert {"rank [places]", "speed [mm/ms]", "time [ms]", "ranks"} <= set(words)
    mesh = map_of(figure)
    np.testing.assert_array_equal(mesh.get_array(), own.T)
    edges = mesh.get_coordinates()[:, 0, 1]
    np.testing.assert_allclose(edges, [0, *(np.arange(ELEMENTS) + 0.5) / ELEMENTS, 1], atol=1e-12)


def test_shapes_are_a_few_states_from_the_side(scene, run, tmp_path):
    figure = rx.picture(scene, run, states=3)
    words = drawn(figure, tmp_path)
    assert {"t = 0 s", "t = 0.3 s", "t = 0.6 s", "-e1 [m]", "e3 [m]"} <= set(words)
    assert "strain energy density [J/m]" in words
    tubes = [axes for axes in figure.findobj(PolyCollection) if len(axes.get_paths()) > 100]
    assert len(tubes) == 3
    above = rx.picture(scene, run, "shapes", view=rx.plot.View((1, 0, 0), (0, 1, 0)), magnify=3.0)
    words = drawn(above, tmp_path)
    assert {"e1 [m]", "e2 [m]", "tubes drawn 3 times as thick as they are"} <= set(words)


def test_shapes_are_laid_out_by_their_proportions():
    assert _columns(4, 0.1) == 1  # long and flat: below each other
    assert _columns(4, 0.6) == 2
    assert _columns(4, 0.9) == 4  # three columns would leave places empty
    assert _columns(3, 5.0) == 3


def test_names_are_panels_of_one_figure(scene, run, tmp_path):
    figure = rx.picture(scene, run, "energies", "topology", "reactions")
    words = set(drawn(figure, tmp_path))
    # C (t/2)^2 / 2 at t = 0.6
    lines = curves_of(figure.subfigs[0])
    np.testing.assert_allclose(lines["torsion"].get_ydata()[-1], 0.5 * 0.8 * 0.3**2, rtol=1e-9)
    assert "kinetic" not in lines
    lines = curves_of(figure.subfigs[1])
    np.testing.assert_allclose(lines["twist Tw"].get_ydata()[-1], 0.3 / (2 * np.pi), rtol=1e-9)
    assert "turns applied" not in lines  # about e3, which is not the rod's tangent
    # C tau about the rod, which the first end takes up
    lines = figure.subfigs[2].findobj(matplotlib.lines.Line2D)
    own = [line.get_ydata() for line in lines if line.get_label() == "first end, e1"]
    ends = [values[-1] for values in own if len(values) == 7]  # legends have lines too
    np.testing.assert_allclose(np.max(np.abs(ends)), 0.8 * 0.3, rtol=1e-6)
    assert {"energy [J]", "turns", "torque [N m]", "force [N]"} <= words


def test_what_failed_is_shown_as_far_as_it_went(scene, failed, tmp_path):
    figure = rx.picture(scene, failed, "curvature", "energies", "shapes")
    words = drawn(figure, tmp_path)
    told = "a rod of 6 elements; the run ended by NEWTON_FAILED; 3 of 7 states are no numbers"
    assert any(told in word for word in words)
    assert map_of(figure).get_array().shape == (ELEMENTS, 4)
    assert any("3 of 7 points are not finite" in word for word in words)
    assert "t = 0.3 s" in words
    none = eqx.tree_at(lambda r: r.states.position, failed, failed.states.position * jnp.nan)
    words = drawn(rx.picture(scene, none, "energies"), tmp_path)
    assert "there is nothing to show" in words
    assert any("7 of 7 states are no numbers" in word for word in words)


def test_a_start_alone_is_said_to_be_so(scene, run, tmp_path):
    begun = of_no_steps(run.state(0))
    words = drawn(rx.picture(scene, begun, "shapes", "twist", "energies"), tmp_path)
    assert any("the start alone: no step is in the run" in word for word in words)
    assert "no strain energy" in words
    placed = drawn(rx.picture(scene), tmp_path)  # without a run
    assert "a rod of 6 elements" in placed
    empty = dataclasses.replace(run, states=jax.tree.map(lambda leaf: leaf[:0], run.states))
    words = drawn(rx.picture(scene, empty), tmp_path)
    assert any("the run holds no state" in word for word in words)


def test_every_one_of_several_rods_is_shown(tmp_path):
    rods = [rx.straight_rod(1.0, n, UNIT_SECTION, origin=(0, n, 0)) for n in (3, 4)]
    body = rx.Body(2.0, (1.0, 1.0, 1.0), position=(1.0, 1.0, 1.0))
    scene = rx.Scene(rods=rods, first_end=(rx.Clamped(), rx.Free()), bodies=(body,))
    run = standing_run(scene, 2)
    words = drawn(rx.picture(scene, run, "curvature", "topology"), tmp_path)
    assert {"rod 0: arc length s [m]", "rod 1: arc length s [m]"} <= set(words)
    assert {f"rod {i}: conversion of twist to writhe" for i in (0, 1)} <= set(words)
    figure = rx.picture(scene, run, "speed")
    shapes = [mesh.get_array().shape for mesh in figure.findobj(QuadMesh)[:2]]
    assert shapes == [(4, 3), (5, 3)]
    assert "2 rods of 3, 4 elements and 1 body" in drawn(figure, tmp_path)


def test_a_name_that_is_none_is_refused_with_those_there_are(scene, run):
    with pytest.raises(ValueError, match=r"no picture 'bending' of this scene; give some of 'shap"):
        rx.picture(scene, run, "shapes", "bending")
    free = rx.Scene(scene.rod)
    with pytest.raises(ValueError, match="no picture 'reactions'") as told:
        rx.picture(free, run, "reactions")
    assert "'topology'" in str(told.value) and "'contact force'" not in str(told.value)
    with pytest.raises(ValueError, match="states: must be a whole number"):
        rx.picture(scene, run, states=0)


def test_what_is_next_to_nothing_is_left_out():
    curves = {"a": [1.0, -2.0], "b": [1e-9, 0.0], "c": None, "d": [np.nan, 1e-3]}
    assert list(_that_matter(curves)) == ["a", "d"]
    assert list(_that_matter({"x": np.zeros(3), "y": np.zeros(3)})) == ["x"]
    np.testing.assert_allclose(between(np.array([0.0, 1.0, 3.0])), [-0.5, 0.5, 2.0, 4.0])
    np.testing.assert_allclose(between(np.array([2.0])), [1.5, 2.5])
