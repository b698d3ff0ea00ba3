"""Pages that show runs: they hold what the run holds, say what they lack, are seen in a browser."""

import dataclasses
import html
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from helpers import UNIT_SECTION, standing_run

import rodjax as rx
from rodjax.viewing import bodies, colouring, packing
from rodjax.viewing.tubes import View

ELEMENTS = 6


@pytest.fixture(scope="module")
def scene():
    """A clamped rod that slides at first, and is then pinned."""
    rod = rx.straight_rod(1.0, ELEMENTS, UNIT_SECTION, direction=(1, 0, 0))
    return rx.Scene(rod, rx.Clamped(), rx.Switched(rx.Slider((1, 0, 0)), rx.Pinned(), 0.25))


@pytest.fixture(scope="module")
def run(scene):
    """Eleven states, one moved by hand so that something is to be seen."""
    made = standing_run(scene, 10)
    time = np.asarray(made.times)[:, None]
    s = np.linspace(0, 1, ELEMENTS + 1)[None]
    position = np.stack([s + 0 * time, 0.2 * time * s**2, 0.1 * np.sin(5 * time) * s**2], -1)
    angle = 0.5 * time * s
    frames = rx.rotations.multiply(
        made.states.quaternion,
        jnp.asarray(np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], -1)),
    )
    where = lambda run: (run.states.position, run.states.quaternion)
    return eqx.tree_at(where, made, (jnp.asarray(position), frames))


def told(page):
    """What a page was given."""
    found = re.search(r'id="data">(.*?)</script>', page.page, re.DOTALL)
    return json.loads(found[1])


def positions_in(data):
    shape = (len(data["times"]), data["nodes"], 3)
    return packing.from_text(data["position"], "<f4").reshape(shape) + np.asarray(data["origin"])


def values_in(data, name):
    (one,) = [measure for measure in data["measures"] if measure["name"] == name]
    levels = packing.Levels(one["values"], one["low"], one["high"])
    values = packing.from_levels(levels).reshape(len(data["times"]), -1)
    return (10**values if one["scale"] == "log" else values), one


def notes(page):
    return [note["text"] for note in told(page)["notes"]]


def test_a_page_holds_the_run(scene, run):
    page = rx.view(scene, run, colour="twist", title="a <b> & c")
    data = told(page)
    assert data["title"] == "a <b> & c" and "<title>a &lt;b&gt; &amp; c</title>" in page.page
    np.testing.assert_array_equal(data["times"], run.times)
    np.testing.assert_allclose(positions_in(data), run.states.position, atol=1e-6)
    frames = packing.from_text(data["quaternion"], "<i2").reshape(11, -1, 4) / 32767
    np.testing.assert_allclose(frames, run.states.quaternion, atol=2e-5)
    twist, one = values_in(data, "twist")
    # a frame turns by t/2 over the length 1
    expected = np.broadcast_to(0.5 * np.asarray(run.times)[:, None], twist.shape)
    np.testing.assert_allclose(twist, expected, atol=1e-4)
    assert (one["unit"], one["at"], one["scale"]) == ("rad/m", "elements", "signed")
    assert data["measures"][data["colour"]]["name"] == "twist"
    density, one = values_in(data, "strain energy density")
    expected = rx.energy.strain_energy_density(scene.rod, run.final)
    np.testing.assert_allclose(density[-1], expected, rtol=1e-3)
    assert one["unit"] == "J/m"
    assert "http" not in page.page and "src=" not in page.page  # nothing is fetched


def test_obstacles_are_in_the_page_and_push():
    rod = rx.straight_rod(1.0, 4, UNIT_SECTION, direction=(1, 0, 0))
    moved = rx.Constant((0.0, 0.0, 0.02))
    plane = rx.Obstacle(rx.Plane((0, 0, -0.07)), 100.0, softness=1e-3, displacement=moved)
    away = rx.Obstacle(rx.SignedDistance(lambda height, point: height - point[2], 9.0), 1.0)
    scene = rx.Scene(rod, rx.Free(), loads=(plane, away))
    state = rx.placing(scene)
    sunk = dataclasses.replace(state, position=state.position - jnp.asarray([[0.0, 0.0, 0.01]]))
    page = rx.view(scene, [state, sunk])
    data = told(page)
    force, one = values_in(data, "contact force")
    # k (depth - width/2) per length, width = softness D
    np.testing.assert_allclose(force[1], 100.0 * (0.01 - 0.5e-4), rtol=1e-4)
    np.testing.assert_allclose(force[0], 0.0, atol=1e-4)
    assert (one["unit"], one["at"]) == ("N/m", "nodes")
    (body,) = data["bodies"]
    points = packing.from_text(body["patches"][0]["points"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points[:, 2] + data["origin"][2], -0.07, atol=1e-6)
    shift = packing.from_text(body["shift"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(shift, [[0, 0, 0.02]] * 2, atol=1e-7)
    assert "loads[1], a SignedDistance, is not in the picture" in notes(page)


def test_speed_and_tension_are_those_of_the_states():
    rod = rx.straight_rod(1.0, 4, UNIT_SECTION)
    state = rx.placing(rx.Scene(rod))
    rate = state.rate.at[:, 1].set(jnp.linspace(0.0, 2.0, 5))
    state = dataclasses.replace(state, rate=rate, force=state.force.at[:, 2].set(-3.0))
    data = told(rx.view(rx.Scene(rod), state, units=rx.units.Units("nm", "us", "g", "pN")))
    speed, one = values_in(data, "speed")
    np.testing.assert_allclose(speed[0], np.linspace(0, 2, 5), atol=1e-4)
    assert one["unit"] == "nm/us" and data["units"] == {"length": "nm", "time": "us"}
    tension, one = values_in(data, "tension")
    np.testing.assert_allclose(tension[0], -3.0, atol=1e-4)
    assert one["unit"] == "pN" and (one["low"], one["high"]) == (-3.0, 3.0)
    assert [m["name"] for m in data["measures"]] == [
        "strain energy density", "curvature", "twist", "tension", "speed",
    ]  # fmt: skip


def test_shapes_have_pictures():
    low, high = -np.ones(3), np.ones(3)
    (plane,) = rx.Plane((0, 0, -1), (0, 1, 1)).patches(low, high)
    np.testing.assert_allclose(plane[..., 1] + plane[..., 2], -1.0, atol=1e-12)
    assert np.min(np.ptp(plane, (0, 1))) > 2.0  # wider than the box
    (sphere,) = rx.Sphere((0.5, 1.0, 0.0), 0.5).patches(low, high)
    np.testing.assert_allclose(np.linalg.norm(sphere - [0.5, 1, 0], axis=-1), 0.5, atol=1e-12)
    (pipe,) = rx.Cylinder((0, 0, 0), (3, 0, 0), 2.0, inside=True).patches(low, high)
    np.testing.assert_allclose(np.linalg.norm(pipe[..., 1:], axis=-1), 2.0, atol=1e-12)
    assert np.min(pipe[..., 0]) < -1 and np.max(pipe[..., 0]) > 1
    hill = rx.HeightField(-3.0 + np.outer([0, 1, 0], [0, 1, 0]))
    (ground,) = hill.patches(low, high)
    assert np.max(ground[..., 2]) == pytest.approx(-2.0, abs=1e-2)


def test_a_signed_distance_has_a_picture():
    # a torus of the radii 0.6 and 0.3
    def torus(radii, point):
        ring = jnp.sqrt(jnp.sum(point[:2] ** 2)) - radii[0]
        return jnp.sqrt(ring**2 + point[2] ** 2) - radii[1]

    shape, box = rx.SignedDistance(torus, jnp.array([0.6, 0.3])), np.full(3, 1.0)
    assert shape.patches(-box, box) == []
    found = bodies._found(shape, -box, box, 0 * box)
    vertices = packing.from_text(found["vertices"], "<f4").reshape(-1, 6).astype(float)
    faces = packing.from_text(found["faces"], "<u4").reshape(-1, 3)
    points, normals = vertices[:, :3], vertices[:, 3:]
    ring = np.linalg.norm(points[:, :2], axis=1) - 0.6
    np.testing.assert_allclose(np.hypot(ring, points[:, 2]), 0.3, atol=1e-6)
    np.testing.assert_allclose(normals[:, 2], points[:, 2] / 0.3, atol=1e-5)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = 0.5 * np.sum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    assert area == pytest.approx(4 * np.pi**2 * 0.6 * 0.3, rel=0.01)
    # closed: each edge is that of two triangles, and its holes are those of a torus
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    different, times = np.unique(edges, axis=0, return_counts=True)
    assert np.all(times == 2) and len(points) - len(different) + len(faces) == 0
    far = bodies._found(shape, box + 3, box + 4, 0 * box)
    assert far is None


def test_holds_are_in_the_page(scene, run):
    clamp, last = told(rx.view(scene, run))["holds"]
    assert clamp["node"] == 0 and clamp["spans"][0]["kind"] == "plate"
    before, after = last["spans"]
    np.testing.assert_allclose(np.abs(before["axis"]), [1, 0, 0], atol=1e-12)
    assert (before["kind"], after["kind"], after["after"]) == ("plate", "ball", 0.25)
    assert after["axis"] is None and last["node"] == ELEMENTS


def test_several_rods_are_apart():
    rods = [rx.straight_rod(1.0, n, UNIT_SECTION, origin=(0, n, 0)) for n in (3, 4)]
    scene = rx.Scene(rods=rods)
    data = told(rx.view(scene, rx.placing(scene)))
    assert data["parts"] == [[0, 3], [4, 8]] and data["nodes"] == 9
    curvature, _ = values_in(data, "curvature")
    assert np.isnan(curvature[0, 3]) and np.sum(np.isnan(curvature)) == 1


def test_size_is_bounded():
    rod = rx.straight_rod(1.0, 200, UNIT_SECTION)
    scene = rx.Scene(rod, rx.Clamped())
    page = rx.view(scene, standing_run(scene, 400))
    assert page.frames == 300 and len(page.page) < 5e6
    assert "300 of 401 states" in notes(page)
    assert {told(page)["times"][0], told(page)["times"][-1]} == {0.0, 40.0}


def test_a_failed_run_says_so_and_shows_what_there_is(scene, run):
    lost = run.states.position.at[4:].set(jnp.nan)
    where = lambda run: (run.states.position, run.result)
    failed = eqx.tree_at(where, run, (lost, jnp.asarray(3, jnp.int32)))
    page = rx.view(scene, failed)
    assert len(told(page)["times"]) == 4
    words = notes(page)
    assert any(word.startswith("The run ended by NEWTON_FAILED (3): ") for word in words)
    assert "7 of 11 states are no numbers, and not shown" in words
    empty = rx.view(
        scene, dataclasses.replace(failed, states=jax.tree.map(lambda x: x[4:], failed.states))
    )
    assert empty.frames == 0 and "7 of 7 states are no numbers, and not shown" in notes(empty)
    none = dataclasses.replace(failed, states=jax.tree.map(lambda x: x[:0], failed.states))
    assert "The run holds no state" in notes(rx.view(scene, none))


def test_files_states_and_scenes_are_shown(scene, run, tmp_path):
    rx.storage.save(tmp_path / "run.h5", scene, run, units=rx.units.Units(length="cm"))
    data = told(rx.view(tmp_path / "run.h5"))
    assert data["units"]["length"] == "cm" and len(data["times"]) == 11
    assert told(rx.view(rx.storage.load(tmp_path / "run.h5"))) == data
    assert told(rx.view(scene))["times"] == [0.0]
    assert told(rx.view(scene, [run.state(1), run.state(5)]))["times"] == [0.1, 0.5]


def test_views_and_thickness(scene, run):
    data = told(rx.view(scene, run, magnify=3.0, first_view=View((0, 1, 0), (0, 0, 1))))
    np.testing.assert_allclose(data["axes"], [[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    assert data["magnify"] == 3 and data["yaw"] == 0
    assert told(rx.view(scene, run))["magnify"] == 1  # thick enough to be seen
    thin = rx.circular_section(1e-4, 1e7, 4e6, 1000.0)
    thin = rx.Scene(rx.straight_rod(1.0, 4, thin, direction=(0, 1, 0)))
    data = told(rx.view(thin))
    assert data["magnify"] == 100  # a hundredth of the length
    np.testing.assert_allclose(data["axes"], [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-12)
    bare = rx.Scene(rx.straight_rod(1.0, 4, rx.Section((1.0, 1.0, 1.0), mass=1.0)))
    assert "no diameter was given: drawn as a two hundredth of the length" in notes(rx.view(bare))


def test_own_measures_are_among_the_others(scene, run):
    mine = np.outer(np.arange(11.0), np.ones(ELEMENTS + 1))
    page = rx.view(scene, run, colour="mine", measures={"mine": mine}, measure_units={"mine": "K"})
    values, one = values_in(told(page), "mine")
    np.testing.assert_allclose(values, mine, atol=1e-3)
    assert (one["unit"], one["at"], one["scale"]) == ("K", "nodes", "linear")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"colour": "stress"}, "colour: there is no measure 'stress' .* 'curvature', 'twist', "),
        ({"measures": {"a": np.ones(3)}}, r"measures: 'a' must have shape \(11, 6\), .* \(11, 7\)"),
        ({"measure_units": {"a": "m"}}, "measure_units: 'a' is not among the measures"),
        ({"magnify": 0.0}, "magnify: must be positive"),
        ({"frames": 0}, "frames"),
    ],
)
def test_what_does_not_fit_is_told(scene, run, settings, message):
    with pytest.raises(ValueError, match=message):
        rx.view(scene, run, **settings)


def test_what_is_no_run_is_told(scene, run, tmp_path):
    with pytest.raises(
        ValueError, match=r"scene: a run does not keep its scene; .* view\(scene, run"
    ):
        rx.view(run)
    with pytest.raises(ValueError, match="run: give a Run, a State or a sequence of them"):
        rx.view(scene, 3.0)
    with pytest.raises(ValueError, match="the scene's rod 5 nodes"):
        rx.view(rx.Scene(rx.straight_rod(1.0, 4, UNIT_SECTION)), run)
    with pytest.raises(ValueError, match=r"path: name a file that ends in \.html"):
        rx.view(scene, run).save(tmp_path / "run.h5")


def test_values_survive_packing():
    values = np.array([[0.0, 0.25, np.nan, 2.0]])
    packed = packing.levels(values, 0.0, 1.0)
    np.testing.assert_allclose(packing.from_levels(packed), [0.0, 0.25, np.nan, 1.0], atol=1e-5)
    one = colouring.Measure("a", "", "linear", np.full((2, 3), 4.0))
    assert colouring.bounds(one) == (0.0, 4.0)


def test_lumps_and_bodies_are_where_they_are():
    rod = rx.straight_rod(1.0, 4, UNIT_SECTION)
    lumps = rx.Lump(-1, 1.0, offset=(0.0, 0.1, 0.0)), rx.Lump(2, 1.0, volume=np.pi / 6)
    # of a uniform box of sides 1, 2 and 3, and a mass of 12
    body = rx.Body(12.0, (13.0, 10.0, 5.0), (1.0, 0.0, 0.0))
    scene = rx.Scene(rod, lumps=lumps, bodies=(body,))
    last, ball, box = bodies.lumps(scene)
    assert (last["node"], last["offset"], last["radius"]) == (4, [0.0, 0.1, 0.0], None)
    assert ball["node"] == 2 and ball["radius"] == pytest.approx(0.5) and ball["halves"] is None
    assert box["node"] == 5 and box["halves"] == pytest.approx([0.5, 1.0, 1.5])
    page = rx.view(scene)
    assert told(page)["parts"] == [[0, 4]] and page.title == "a rod of 4 elements and 1 body"


def test_no_hold_is_no_mark():
    assert bodies.holds(rx.Scene(rx.straight_rod(1.0, 4, UNIT_SECTION))) == []


def test_a_notebook_gets_the_page_in_a_frame(scene, run, tmp_path):
    page = rx.view(scene, run)
    frame = page._repr_html_()
    assert html.unescape(re.search(r'srcdoc="(.*?)" title', frame, re.DOTALL)[1]) == page.page
    assert page.save(tmp_path / "a" / "run.html").read_text() == page.page
    assert repr(page).startswith("RunView(11 states, ")


BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")


def browsed(page, tmp_path, link, *asked):
    """What a browser says of a page, after some seconds of its own time."""
    flags = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--hide-scrollbars"]
    flags += ["--enable-unsafe-swiftshader", "--window-size=800,600", "--virtual-time-budget=3000"]
    address = f"file://{page.save(tmp_path / 'run.html')}#{link}"
    command = [BROWSER, *flags, *asked, address]
    done = subprocess.run(command, capture_output=True, timeout=120, check=True)
    return done.stdout.decode()


def seen(page, tmp_path, link):
    """A picture of it."""
    picture = tmp_path / "run.png"
    browsed(page, tmp_path, link, f"--screenshot={picture}")
    return np.asarray(matplotlib.image.imread(picture))[..., :3]


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
def test_a_browser_shows_it(tmp_path):
    """A blue tube, as thick beside its length as it is, and it moves."""
    rod = rx.straight_rod(1.0, 4, UNIT_SECTION, direction=(1, 0, 0))
    scene = rx.Scene(rod)
    state = rx.placing(scene)
    moved = dataclasses.replace(
        state, position=state.position + jnp.asarray([[0.0, 0.0, 0.5]]), time=jnp.asarray(1.0)
    )
    low = -np.ones((2, 4))
    low[0, 0] = 0.5  # of both signs: on a diverging scale, from blue to red
    settings = {"colour": "low", "measures": {"low": low}, "seconds": 0.5}
    page = rx.view(scene, [state, moved], **settings)
    blue = lambda picture: (picture[..., 2] > 1.8 * picture[..., 0]) & (picture[..., 2] > 0.3)
    before, after = (blue(seen(page, tmp_path, f"frame={k}&yaw=0&pitch=0")) for k in (0, 1))
    area = np.s_[50:420, 60:690]  # without words, scale and controls
    rows = [np.mean(np.nonzero(picture[area])[0]) for picture in (before, after)]
    assert rows[1] < rows[0] - 50  # upwards
    columns = np.nonzero(np.any(after[area], 0))[0]
    tall = np.nonzero(np.any(after[area], 1))[0]
    # 0.1 thick and 1 long; lit from above, its lower edge is dark
    assert 0.05 < np.ptp(tall) / np.ptp(columns) < 0.13
    words = browsed(page, tmp_path, "play=1", "--dump-dom")
    assert 'data-ready="yes"' in words
    # in so little of a browser's time it has begun to play
    assert 0 < float(re.search('id="time">t = ([0-9.]*) s', words)[1]) <= 1


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
def test_a_browser_tells_what_is_not_there(run, scene, tmp_path):
    none = dataclasses.replace(run, states=jax.tree.map(lambda x: x[:0], run.states))
    words = browsed(rx.view(scene, none), tmp_path, "", "--dump-dom")
    assert 'data-ready="empty"' in words and ">The run holds no state<" in words


@pytest.mark.slow
def test_all_that_the_docs_show_is_made(tmp_path):
    text = (Path(rx.__file__).parents[1] / "docs" / "looking.md").read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=tmp_path, check=True)
    made = {path.name for path in tmp_path.iterdir()}
    assert made == {"run.html", "run.png", "run.pvd", "run", "run.csv", "spring.csv"}
    assert 1e5 < (tmp_path / "run.html").stat().st_size < 1e6
