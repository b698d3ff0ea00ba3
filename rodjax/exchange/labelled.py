"""A run as a labelled data set of xarray, and through it in netCDF, Zarr, tables and CSV."""

from typing import TYPE_CHECKING, Any

import numpy as np

from rodjax.dynamics.run import Run
from rodjax.exchange.node_columns import part_of_nodes
from rodjax.files.versions import version
from rodjax.inputs.units import SI, Units
from rodjax.inputs.validation import check_flag
from rodjax.numerics.results import Result
from rodjax.scenes.arguments import check_scene
from rodjax.scenes.scene import Scene
from rodjax.viewing.colouring import measures_of

if TYPE_CHECKING:
    from xarray import Dataset

_INERTIAL, _BODY = ["e1", "e2", "e3"], ["a1", "a2", "a3"]


def to_xarray(scene: Scene, run: Run, *, measures: bool = True, units: Units = SI) -> "Dataset":
    """The saved states of a run with their names, places, times and units.

    Dimensions are `time`, `node` and `element`, with the rest arc length `s_node` and `s_element`
    and, of several rods, which of them it is; `inertial`, `body` and `quaternion_part` for the
    components. Elements that are none, between rods, are left out.

    Args:
        scene: of the run, which does not keep it.
        run: whose states have one leading axis.
        measures: with curvature, twist, strain energy density, tension, speed and, where anything
            touches, the contact force, of elements or nodes.
        units: names of the units.

    Raises:
        ImportError: xarray is not installed.
        ValueError: the run is not of this scene.

    Example:
        >>> data = rx.to_xarray(scene, run)
        >>> dict(data.curvature.sizes)
        {'time': 11, 'element': 20}
        >>> data.speed.to_pandas().to_csv("speed.csv")
        >>> data.to_netcdf("run.nc")  # doctest: +SKIP
    """
    try:
        import xarray
    except ImportError as error:
        raise ImportError(
            "to_xarray needs xarray, which the extra `xarray` brings: pip install 'rodjax[xarray]'"
        ) from error
    check_scene(scene)
    check_flag(measures=measures)
    rod, states = scene.rod, run.states
    shape, nodes = np.shape(states.position), rod.elements + 1
    if len(shape) != 3 or shape[1:] != (nodes, 3):
        raise ValueError(
            f"run: has positions of shape {shape}, the scene's rod {nodes} nodes; give the scene"
            " that the run is of"
        )
    solid = np.delete(np.arange(rod.elements), list(rod.breaks))
    rod_of_node = part_of_nodes(rod)
    u, rate = units, np.asarray(states.rate)
    per_time = ("time", "node")
    variables: dict[str, Any] = {
        "position": ((*per_time, "inertial"), states.position, u.length, "R, of the nodes"),
        "quaternion": (
            (*per_time, "quaternion_part"), states.quaternion, "1",
            "frames of the nodes, body to inertial",
        ),
        "velocity": ((*per_time, "inertial"), rate[..., :3], f"{u.length}/{u.time}", "v"),
        "angular_velocity": ((*per_time, "body"), rate[..., 3:], f"rad/{u.time}", "omega"),
        "force": (
            ("time", "element", "body"), np.asarray(states.force)[:, solid], u.force,
            "internal force in the frames of the elements, tension along a3",
        ),
    }  # fmt: skip
    for measure in measures_of(scene, states, units) if measures else ():
        of_elements = measure.values.shape[1] == rod.elements
        values = measure.values[:, solid] if of_elements else measure.values
        dims = ("time", "element") if of_elements else per_time
        variables[measure.name.replace(" ", "_")] = (dims, values, measure.unit, measure.name)
    coordinates: dict[str, Any] = {
        "time": ("time", run.times, u.time, "time"),
        "s_node": ("node", rod.arc_length, u.length, "rest arc length"),
        "s_element": ("element", np.asarray(rod.midpoints)[solid], u.length, "rest arc length"),
    }
    if rod.breaks:
        which = "which of the rods, from 0"
        coordinates["rod_of_node"] = ("node", rod_of_node, "1", which)
        coordinates["rod_of_element"] = ("element", rod_of_node[solid], "1", which)
    labelled = lambda item: (item[0], np.asarray(item[1]), {"units": item[2], "long_name": item[3]})
    names = {"inertial": _INERTIAL, "body": _BODY, "quaternion_part": ["w", "x", "y", "z"]}
    return xarray.Dataset(
        {name: labelled(item) for name, item in variables.items()},
        {name: labelled(item) for name, item in coordinates.items()} | names,
        {"result": Result(int(run.result)).name, "rodjax_version": version()},
    )
