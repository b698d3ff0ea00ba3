"""Runs as data sets of xarray: names, units, places and values."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import UNIT_SECTION, standing_run

import rodjax as rx

xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def scene():
    """Two rods of three and four elements."""
    rods = [rx.straight_rod(1.0, n, UNIT_SECTION, origin=(0, n, 0)) for n in (3, 4)]
    return rx.Scene(rods=rods)


@pytest.fixture(scope="module")
def data(scene):
    return rx.to_xarray(scene, standing_run(scene, 5))


def test_everything_has_its_name_place_and_unit(scene, data):
    assert dict(data.sizes) == {
        "time": 6, "node": 9, "element": 7, "inertial": 3, "body": 3, "quaternion_part": 4,
    }  # fmt: skip
    assert all("units" in data[name].attrs for name in data.data_vars)
    assert data.strain_energy_density.attrs["units"] == "J/m"
    assert data.twist.dims == ("time", "element") and data.speed.dims == ("time", "node")
    assert data.attrs["result"] == "SUCCESS"
    np.testing.assert_array_equal(data.rod_of_node, [0] * 4 + [1] * 5)
    np.testing.assert_array_equal(data.rod_of_element, [0] * 3 + [1] * 4)
    np.testing.assert_allclose(data.s_element[:3], np.array([1, 3, 5]) / 6)
    np.testing.assert_allclose(data.s_element[3:], np.array([1, 3, 5, 7]) / 8)
    second = data.position.sel(inertial="e2").sel(time=0.2, method="nearest")
    second = second[data.rod_of_node == 1]
    np.testing.assert_allclose(second, 4.0)
    assert np.all(np.isfinite(data.curvature))


def test_it_goes_on_to_tables(data, tmp_path):
    data.speed.to_pandas().to_csv(tmp_path / "speed.csv")
    assert len((tmp_path / "speed.csv").read_text().splitlines()) == 7


def test_what_does_not_fit_is_told(scene):
    other = rx.Scene(rx.straight_rod(1.0, 4, UNIT_SECTION))
    with pytest.raises(ValueError, match="the scene's rod 5 nodes"):
        rx.to_xarray(other, standing_run(scene, 1))
    bare = rx.to_xarray(other, standing_run(other, 1), measures=False, units=rx.units.Units("nm"))
    assert "curvature" not in bare and bare.position.attrs["units"] == "nm"
    assert "rod_of_node" not in bare.coords
    assert bare.s_node[-1] == jnp.asarray(1.0)


def test_the_extra_is_named_where_xarray_is_missing():
    code = (
        "import sys; sys.modules['xarray'] = None\n"
        "import rodjax as rx\n"
        "try: rx.to_xarray(None, None)\n"
        "except ImportError as error: assert \"pip install 'rodjax[xarray]'\" in str(error)\n"
        "else: raise SystemExit('no error')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
