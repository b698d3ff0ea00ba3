"""Runs as tables and meshes: names, units, places and values, read again by plain parsers."""

import base64
import csv
from xml.etree import ElementTree

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, standing_run

import rodjax as rx
from rodjax.exchange.node_columns import at_nodes


@pytest.fixture(scope="module")
def scene():
    """Two rods of three and four elements, and a body by itself."""
    rods = [rx.straight_rod(1.0, n, UNIT_SECTION, origin=(0, n, 0)) for n in (3, 4)]
    body = rx.Body(2.0, (1.0, 1.0, 1.0), position=(9.0, 8.0, 7.0))
    return rx.Scene(rods=rods, bodies=(body,))


@pytest.fixture(scope="module")
def run(scene):
    """Three states, moving along e1, the frames of the second rod turned more and more."""
    made = standing_run(scene, 2)
    s = np.asarray(scene.rod.arc_length)
    angle = np.where(np.arange(10) >= 4, 0.6 * s, 0.0)
    turned = jnp.asarray(np.stack([np.cos(angle / 2), 0 * s, 0 * s, np.sin(angle / 2)], -1))
    where = lambda run: (run.states.quaternion, run.states.rate)
    frames = made.states.quaternion.at[2].set(turned)
    return eqx.tree_at(where, made, (frames, made.states.rate.at[..., 0].set(0.25)))


def test_a_table_has_a_row_for_every_node_at_every_time(scene, run, tmp_path):
    path = rx.to_csv(scene, run, tmp_path / "new" / "run.csv")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:10] == [
        "time [s]", "rod", "node", "s [m]", "x [m]", "y [m]", "z [m]",
        "vx [m/s]", "vy [m/s]", "vz [m/s]",
    ]  # fmt: skip
    assert {"twist [rad/m]", "strain energy density [J/m]", "tension [N]"} <= set(rows[0])
    assert len(rows) == 3 * 10
    second = rows[20 + 6]  # of the last state the third node of the second rod
    assert [second[name] for name in ("time [s]", "rod", "node", "s [m]")] == [
        "0.2", "1", "2", "0.5",
    ]  # fmt: skip
    assert [float(second[f"{axis} [m]"]) for axis in "xyz"] == [0.0, 4.0, 0.5]
    assert float(second["vx [m/s]"]) == float(second["speed [m/s]"]) == 0.25
    np.testing.assert_allclose(float(second["twist [rad/m]"]), 0.6, rtol=1e-12)
    # A tau^2 / 2 with C = 0.8
    found = float(second["strain energy density [J/m]"])
    np.testing.assert_allclose(found, 0.5 * 0.8 * 0.6**2, rtol=1e-9)
    body = rows[-1]
    assert (body["rod"], body["x [m]"], body["twist [rad/m]"]) == ("2", "9", "")
    bare = rx.to_csv(scene, run.state(0), tmp_path / "a.csv", measures=False)
    assert len(bare.read_text().splitlines()) == 11 and "twist" not in bare.read_text()


def test_values_of_elements_are_shared_by_length(scene):
    values = np.full((1, 9), np.nan)
    values[0, :3], values[0, 4:8] = (1.0, 2.0, 4.0), 7.0
    found = at_nodes(scene.rod, values)[0]
    np.testing.assert_allclose(found, [1.0, 1.5, 3.0, 4.0, 7, 7, 7, 7, 7, np.nan])
    uneven = rx.straight_rod(1.0, 4, UNIT_SECTION, jumps=(0.75,))
    share = np.asarray(uneven.length)
    found = at_nodes(uneven, np.arange(4.0)[None])[0]
    np.testing.assert_allclose(found[3], (2 * share[2] + 3 * share[3]) / (share[2] + share[3]))


def read_array(element):
    """Numbers of a data array of a mesh, as the format's description says."""
    content = base64.b64decode(element.text)
    assert int.from_bytes(content[:8], "little") == len(content) - 8
    kinds = {"Float64": "<f8", "Int64": "<i8"}
    values = np.frombuffer(content[8:], kinds[element.get("type")])
    return values.reshape(-1, int(element.get("NumberOfComponents"))).squeeze()


def test_meshes_hold_the_states_and_the_collection_their_times(scene, run, tmp_path):
    path = rx.to_paraview(scene, run, tmp_path / "swing.pvd")
    sets = ElementTree.parse(path).getroot().findall("Collection/DataSet")
    assert [float(one.get("timestep")) for one in sets] == [0.0, 0.1, 0.2]
    files = [path.parent / one.get("file") for one in sets]
    assert sorted(files) == sorted((tmp_path / "swing").iterdir())
    root = ElementTree.parse(files[2]).getroot()
    assert root.attrib == {
        "type": "PolyData", "version": "1.0", "byte_order": "LittleEndian", "header_type": "UInt64",
    }  # fmt: skip
    arrays = {a.get("Name"): read_array(a) for a in root.findall("PolyData/Piece/PointData/*")}
    np.testing.assert_array_equal(
        read_array(root.find("PolyData/Piece/Points/DataArray")), run.final.position
    )
    (piece,) = root.findall("PolyData/Piece")
    assert [piece.get(f"NumberOf{kind}") for kind in ("Points", "Lines", "Verts")] == [
        "10", "2", "1",
    ]  # fmt: skip
    cells = {
        (kind, a.get("Name")): read_array(a)
        for kind in ("Lines", "Verts")
        for a in piece.find(kind)
    }
    np.testing.assert_array_equal(cells["Lines", "connectivity"], np.arange(9))
    np.testing.assert_array_equal(cells["Lines", "offsets"], [4, 9])
    assert cells["Verts", "connectivity"] == 9 and cells["Verts", "offsets"] == 1
    np.testing.assert_array_equal(arrays["rod"], [0] * 4 + [1] * 5 + [2])
    np.testing.assert_allclose(arrays["radius [m]"], [0.05] * 9 + [0.0])
    np.testing.assert_array_equal(arrays["velocity [m/s]"], [[0.25, 0, 0]] * 10)
    # turned by 0.6 s about e3
    angle = np.where(np.arange(10) >= 4, 0.6 * np.asarray(scene.rod.arc_length), 0.0)
    expected = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    np.testing.assert_allclose(arrays["a1"], expected, atol=1e-12)
    np.testing.assert_allclose(arrays["a3"], [[0, 0, 1]] * 10, atol=1e-12)
    np.testing.assert_allclose(arrays["twist [rad/m]"][4:9], 0.6, rtol=1e-9)
    assert read_array(root.find("PolyData/FieldData/DataArray")) == 0.2


def test_a_folder_is_taken_as_well_and_what_is_no_number_left_out(scene, run, tmp_path):
    nan = eqx.tree_at(lambda r: r.states.position, run, run.states.position.at[1].set(jnp.nan))
    path = rx.to_paraview(scene, nan, tmp_path / "out", measures=False)
    assert path == tmp_path / "out" / "run.pvd"
    assert len(list((tmp_path / "out" / "run").iterdir())) == 2
    none = eqx.tree_at(lambda r: r.states.position, run, run.states.position * jnp.nan)
    with pytest.raises(ValueError, match="none of its 3 states"):
        rx.to_paraview(scene, none, tmp_path / "out")
    with pytest.raises(ValueError, match="ends in .pvd"):
        rx.to_paraview(scene, run, tmp_path / "run.vtu")
    with pytest.raises(ValueError, match="ends in .csv"):
        rx.to_csv(scene, run, tmp_path / "run.xls")
    with pytest.raises(ValueError, match="scene's rod 5 nodes"):
        rx.to_csv(rx.Scene(rx.straight_rod(1.0, 4, UNIT_SECTION)), run, tmp_path / "run.csv")
