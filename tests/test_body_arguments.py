"""What makes no body, and no joint, support or drag of one."""

import pytest
from test_bodies import PENDULUM, STAND, UPPER

import rodjax as rx

REFUSED = {
    "mass": ("mass: must be positive", lambda: rx.Body(-1.0, (1.0, 1.0, 1.0), (0, 0, 0))),
    "inertia": ("inertia: no body has", lambda: rx.Body(1.0, (1.0, 1.0, 3.0), (0, 0, 0))),
    "no inertia": ("inertia: give the moments", lambda: rx.Body(1.0, None, (0, 0, 0))),
    "position": ("position: must be three", lambda: rx.Body(1.0, (1, 1, 1), 0.0)),
    "quaternion": (
        "quaternion: must have unit",
        lambda: rx.Body(1.0, (1, 1, 1), (0, 0, 0), (1, 1, 0, 0)),
    ),
    "end": ("end: give an end", lambda: rx.Body(1.0, (1, 1, 1), (0, 0, 0), end="held")),
    "no tuple": ("bodies: give a tuple", lambda: rx.Scene(STAND, bodies=UPPER)),
    "no body": (r"bodies\[0\]: give a body", lambda: rx.Scene(STAND, bodies=(1.0,))),
    "no rod": ("rod: give one rod", lambda: rx.Scene(bodies=(UPPER,))),
    "twice": (
        "bodies: the rod is one of a scene that has bodies",
        lambda: rx.Scene(PENDULUM.rod, bodies=(UPPER,)),
    ),
    "in a chain": (
        r"rods\[1\]: it has bodies",
        lambda: rx.Scene(rods=(STAND, PENDULUM.rod)),
    ),
    "no mass": (
        "bodies: beside rods with mass=None",
        lambda: rx.Scene(
            rx.straight_rod(1.0, 3, rx.Section((1.0, 1.0, 1.0))),
            loads=(rx.LinearDrag(1.0, 1.0, 1.0),),
            bodies=(UPPER,),
        ),
    ),
    "point on no body": (
        r"joints\[0\].second: body: the scene's bodies are 0 to 0, got 1",
        lambda: rx.Scene(STAND, bodies=(UPPER,), joints=(rx.Ball(rx.Point(0), rx.Point(body=1)),)),
    ),
    "point on none": (
        "body: the scene's bodies are none",
        lambda: rx.Scene(STAND, joints=(rx.Ball(rx.Point(0), rx.Point(body=0)),)),
    ),
    "point on both": ("body: a point is on a body or", lambda: rx.Point(2, body=0)),
    "support of a body": (
        "rod: the scene's rods are 0 to 0",
        lambda: rx.Scene(STAND, bodies=(UPPER,), supports=(rx.Support(0, rx.Pinned(), rod=1),)),
    ),
    "apart": (
        "its points are 0.3 apart",
        lambda: rx.Scene(STAND, bodies=(UPPER,), joints=(rx.Ball(rx.Point(0), rx.Point(body=0)),)),
    ),
    "drag of no body": (
        "body: the scene has 0 bodies",
        lambda: rx.Scene(STAND, loads=(rx.PointDrag(body=0),)),
    ),
    "drag beyond": ("node: a rod of 2", lambda: rx.Scene(STAND, loads=(rx.PointDrag(3),))),
    "drag of both": ("body: the drag is of a body or", lambda: rx.PointDrag(2, body=0)),
    "negative drag": ("linear: must be finite and not", lambda: rx.PointDrag(linear=-1.0)),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", REFUSED)
def test_bad_bodies_are_refused(case):
    message, make = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        make()
