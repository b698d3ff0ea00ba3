"""Figures of ordinary, unstrained, failed, closed and single states: what they show and say."""

import dataclasses
import inspect

import jax.numpy as jnp
import matplotlib.text
import numpy as np
import pytest
from matplotlib.collections import PolyCollection

import rodjax as rx
from rodjax import plot
from rodjax.viewing.tubes import View, facing

SECTION = rx.circular_section(0.05, 1e7, 4e6, 1000.0)
E1, E2, E3 = np.eye(3)


def _straight(direction=(0.0, 0.0, 1.0)):
    rod = rx.straight_rod(1.0, 10, SECTION, direction=direction)
    return rod, rx.placing(rx.Scene(rod))


def _ring():
    curve = lambda s: np.array([np.cos(s), np.sin(s), 0.0])
    rod = rx.curved_rod(curve, 2 * np.pi, 40, SECTION, stress_free=False)
    return rod, rx.placing(rx.Scene(rod))


def _density(rod, state):
    return np.asarray(rx.energy.strain_energy_density(rod, state))


def _words(figure):
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text) if text.get_text()]


def _drawn(figure, tmp_path):
    """Size of the picture in a file: drawing is what fails, not setting up."""
    figure.savefig(tmp_path / "figure.png", dpi=40)
    return (tmp_path / "figure.png").stat().st_size


def _circle(axes):
    """Where the end s = 0 is marked on the page."""
    (line,) = axes.get_lines()
    return np.array([line.get_xdata()[0], line.get_ydata()[0]])


def test_unstrained_rod_is_drawn_and_said_to_be_so(tmp_path):
    rod, state = _straight()
    figure = plot.snapshots(rod, [state], [_density(rod, state)], title="placing")
    assert _drawn(figure, tmp_path) > 1000
    assert "placing; no strain energy" in _words(figure)
    assert len(figure.axes) == 1  # no scale of what there is none of
    (tube,) = figure.axes[0].findobj(PolyCollection)
    assert len(tube.get_paths()) > 1000


@pytest.mark.parametrize("direction", [E1, E2, E3, -E1, -E2, -E3])
def test_default_view_lays_the_rod_along_the_page_with_its_start_on_the_right(direction, tmp_path):
    rod, state = _straight(direction)
    figure = plot.snapshots(rod, [state], [_density(rod, state)])
    assert _drawn(figure, tmp_path) > 1000
    axes = figure.axes[0]
    left, right = axes.get_xlim()
    assert right - left > 1.0  # all of its length
    np.testing.assert_allclose(_circle(axes), [max(left, right) - 0.0475, 0.0], atol=1e-6)


def test_view_of_the_paper_is_kept_for_its_rod():
    _, state = _straight(E2)
    assert facing([state.position]) == View() == View((0.0, -1.0, 0.0), (1.0, 0.0, 0.0))


def test_wider_direction_points_up():
    s = np.linspace(0.0, 1.0, 11)
    bent = lambda up: np.outer(s, E1) + np.outer(0.3 * s**2, up)
    assert facing([bent(E3)]).up == (0.0, 0.0, 1.0)
    assert facing([bent(E2)]).up == (0.0, 1.0, 0.0)
    assert facing([np.full((11, 3), np.nan), bent(E2)]).up == (0.0, 1.0, 0.0)
    assert facing([np.full((11, 3), np.nan)]) == View()


@pytest.mark.parametrize(
    ("view", "start", "words"),
    [
        (
            View((1, 0, 0), (0, 0, 1)),
            [0.0, 0.0],
            {"e1 [m]; a circle marks the end s = 0", "e3 [m]"},
        ),
        (View((-1, 0, 0), (0, 1, 0)), [0.0, 0.0], {"-e1 [m]; a circle marks the end s = 0"}),
        (
            View((0, 1, 0), (-1, 0, 0)),
            [0.0, 0.0],
            {"-e1 [m]", "e2 [m]; a circle marks the end s = 0"},
        ),
        (
            View((1, 1, 0), (0, 0, 1)),
            [0.0, 0.0],
            {"along the page [m]; a circle marks the end s = 0"},
        ),
    ],
)
def test_labels_are_true_in_every_view(view, start, words, tmp_path):
    rod, state = _straight(E1)
    figure = plot.snapshots(rod, [state], [_density(rod, state)], view=view)
    assert _drawn(figure, tmp_path) > 1000
    assert words <= set(_words(figure))
    np.testing.assert_allclose(_circle(figure.axes[0]), start, atol=1e-12)


@pytest.mark.parametrize("view", [View((1, 0, 0), (2, 0, 0)), View((0, 0, 0), (1, 0, 0))])
def test_view_without_a_plane_is_refused(view):
    rod, state = _straight()
    with pytest.raises(ValueError, match="right, up: give two directions"):
        plot.snapshots(rod, [state], [_density(rod, state)], view=view)


def test_ring_is_seen_face_on(tmp_path):
    rod, state = _ring()
    density = _density(rod, state)
    figure = plot.snapshots(rod, [state], [density])
    assert _drawn(figure, tmp_path) > 1000
    low, high = figure.axes[0].get_ylim()
    assert high - low > 2.0
    # naturally straight, bent to radius 1: A kappa^2 / 2 everywhere, A = E pi d^4 / 64
    np.testing.assert_allclose(density, 0.5 * 1e7 * np.pi * 0.05**4 / 64, rtol=5e-3)


def test_failed_states_are_told_and_the_others_shown(tmp_path):
    rod, state = _ring()
    nan = jnp.full_like(state.position, jnp.nan)
    failed = dataclasses.replace(state, position=nan, time=jnp.asarray(2.0))
    unknown = np.full(rod.elements, np.nan)
    figure = plot.snapshots(rod, [state, failed], [_density(rod, state), unknown])
    assert _drawn(figure, tmp_path) > 1000
    assert {"not finite", "1 of 2 states are not finite", "t = 2 s"} <= set(_words(figure))
    tubes = [len(axes.findobj(PolyCollection)) for axes in figure.axes[:2]]
    assert tubes == [1, 0]
    figure = plot.snapshots(rod, [failed], [unknown])
    assert _drawn(figure, tmp_path) > 1000
    assert "no strain energy; 1 of 1 states are not finite" in _words(figure)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rod, state, d: (rod, state, [d]), "states: give a sequence"),
        (lambda rod, state, d: (rod, [], []), "states: give a sequence"),
        (lambda rod, state, d: (rod, [state], [d, d]), "densities: give those of every state"),
        (lambda rod, state, d: (_straight()[0], [state], [d]), r"states\[0\]: has positions"),
        (lambda rod, state, d: (rod, [state], [d[:-1]]), r"densities\[0\]: must have shape"),
        (
            lambda rod, state, d: (dataclasses.replace(rod, diameter=None), [state], [d]),
            "diameter: tubes need",
        ),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    rod, state = _ring()
    with pytest.raises(ValueError, match=message):
        # as a user without a type checker meets it
        inspect.unwrap(plot.snapshots)(*change(rod, state, _density(rod, state)))


UNITS = rx.units.Units("nm", "s", "pN s^2/nm", "pN")
TIMES = np.linspace(0.0, 1.0, 11)


def _figures(times, values, **options):
    """The figures of curves, each drawn from the same values."""
    marks = {"now": 0.5, "never": np.inf, "elsewhere": 70.0}
    yield plot.energies(times, {"bending": values, "total": values}, marks=marks, **options)
    yield plot.topology(times, values, 2 * values, 3 * values, marks=marks, **options)
    yield plot.reactions(times, {"along": values}, {"drive": values}, turns=values, **options)


@pytest.mark.parametrize(
    "values", [TIMES**2, np.zeros(11), np.full(11, -3.0)], ids=["growing", "zero", "constant"]
)
def test_curves_are_drawn_in_their_units(values, tmp_path):
    for figure in _figures(TIMES, values, units=UNITS):
        assert _drawn(figure, tmp_path) > 1000
        words = set(_words(figure))
        assert "time [s]" in words and "never" not in words and "elsewhere" not in words
        assert words & {"energy [pN nm]", "torque [pN nm]", "turns"}
        assert figure.axes[0].get_xlim() == (0.0, 1.0)


@pytest.mark.parametrize("count", [1, 3])
def test_a_single_time_is_a_point(count, tmp_path):
    for figure in _figures(np.zeros(count), np.ones(count)):
        assert _drawn(figure, tmp_path) > 1000
    (line,) = plot.energies(np.zeros(1), {"total": np.ones(1)}).axes[0].get_lines()
    assert line.get_markevery() == [0]


def test_values_after_a_failure_are_left_out_and_counted(tmp_path):
    values = np.where(TIMES > 0.65, np.nan, TIMES)
    for figure in _figures(TIMES, values):
        assert _drawn(figure, tmp_path) > 1000
        assert any("4 of 11 points are not finite" in word for word in _words(figure))
    for figure in _figures(np.where(TIMES > 0.65, np.nan, TIMES), values):
        assert _drawn(figure, tmp_path) > 1000
        np.testing.assert_allclose(figure.axes[0].get_xlim(), (0.0, 0.6), atol=1e-12)
    for figure in _figures(TIMES, np.full(11, np.nan)):
        assert any("11 of 11 points are not finite" in word for word in _words(figure))


def test_point_between_missing_ones_is_seen():
    values = np.array([1.0, np.nan, 2.0, np.nan, 3.0, 4.0])
    (line,) = plot.energies(np.arange(6.0), {"total": values}).axes[0].get_lines()
    assert line.get_markevery() == [0, 2]


def test_curves_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="bending: has shape"):
        inspect.unwrap(plot.energies)(TIMES, {"bending": TIMES[:-1]})
    with pytest.raises(ValueError, match="at least one curve"):
        plot.energies(TIMES, {})
