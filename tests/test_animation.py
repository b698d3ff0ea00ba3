"""Moving pictures: of as many states as asked for, at their times, with curves beside them."""

import dataclasses

import jax
import numpy as np
import PIL.Image
import pytest
from helpers import UNIT_SECTION, standing_run
from matplotlib.animation import FFMpegWriter

import rodjax as rx
from rodjax.viewing import animation, projection

SCENE = rx.Scene(rx.straight_rod(1.0, 4, UNIT_SECTION, direction=(1, 0, 0)), rx.Clamped())


@pytest.fixture(scope="module")
def run():
    return standing_run(SCENE, 6)


def test_a_gif_shows_the_states(run, tmp_path, monkeypatch):
    drawn, draw = [], projection.Page.draw

    def told(page, axes, index):
        draw(page, axes, index)
        drawn.append((axes.get_xlabel(), axes.get_aspect()))

    monkeypatch.setattr(projection.Page, "draw", told)
    curves = {"a": np.arange(7.0)}
    path = rx.animate(
        SCENE,
        run,
        tmp_path / "run.gif",
        frames=3,
        seconds=1.0,
        curves=curves,
        colour="speed",
        dpi=30,
    )
    assert [label for label, _ in drawn] == [
        f"t = {t} s, lengths in m" for t in ("0", "0.3", "0.6")
    ]
    assert {aspect for _, aspect in drawn} == {1.0}
    with PIL.Image.open(path) as film:
        assert film.n_frames == 3 and film.size[0] == 270


def test_curves_grow_with_time():
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    animation._grow(axes, np.arange(4.0), {"a": np.array([0.0, 2.0, np.nan, 1.0])}, 1.0, "time [s]")
    np.testing.assert_array_equal(axes.get_lines()[0].get_xdata(), [0.0, 1.0])
    assert axes.get_xlim() == (0.0, 3.0) and axes.get_ylim()[1] > 2.0


def test_what_does_not_fit_is_told(run, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"path: name a file that ends in \.gif or \.mp4"):
        rx.animate(SCENE, run, tmp_path / "run.html")
    with pytest.raises(ValueError, match="curves: 'a' must have a value for each of the 7 saved"):
        rx.animate(SCENE, run, tmp_path / "run.gif", curves={"a": np.arange(3.0)})
    none = dataclasses.replace(run, states=jax.tree.map(lambda leaf: leaf[:0], run.states))
    with pytest.raises(ValueError, match="there is nothing to show: The run holds no state"):
        rx.animate(SCENE, none, tmp_path / "run.gif")
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda kind: False))
    with pytest.raises(ValueError, match="mp4 needs the program ffmpeg"):
        rx.animate(SCENE, run, tmp_path / "run.mp4")
