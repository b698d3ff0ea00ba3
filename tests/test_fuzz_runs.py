"""Short runs of scenes drawn at random."""

import jax
import numpy as np
import pytest
from constructor_oracles import OURS, N

import rodjax as rx

pytestmark = pytest.mark.usefixtures("unchecked")


def log_uniform(draw, low, high):
    return float(np.exp(draw.uniform(np.log(low), np.log(high))))


def random_scene(draw, kind):
    """A valid scene of one of few programs, with numbers over wide ranges."""
    vector = lambda size: tuple(size * draw.normal(size=3))
    thickness, length = log_uniform(draw, 1e-4, 0.05), 1.0
    section = rx.circular_section(
        thickness, log_uniform(draw, 1e4, 1e10), log_uniform(draw, 1e4, 1e10), 1e3
    )
    rod = rx.straight_rod(length, N, section, direction=vector(1.0), natural_curvature=vector(1.0))
    ramp = [0.0, log_uniform(draw, 1e-3, 1.0), 2.0]
    along = np.asarray(rod.position[-1] - rod.position[0])
    shift = rx.Smooth(ramp, np.outer([0, 1, 1], vector(0.05)))
    turn = rx.Turn(along, rx.Smooth(ramp, [0.0, draw.normal(), 0.0]))
    weight = rx.Gravity(vector(log_uniform(draw, 1e-3, 1e2)))
    drag = rx.MorisonDrag(*(log_uniform(draw, 1e-3, 1e3) for _ in range(3)))
    pull = rx.PointLoad(-1, rx.Smooth(ramp, np.outer([0, 1, 0], vector(1e-2))))
    ends, loads = {
        "hung": ((rx.Clamped(), rx.Free()), (weight,)),
        "driven": ((rx.Clamped(shift, turn), rx.Slider(along)), (weight, drag)),
        "pulled": ((rx.Clamped(), rx.Free()), (pull, drag)),
    }[kind]
    return rx.Scene(rod, *ends, loads=loads)


# what the grid does not resolve is said, and is no fault
@pytest.mark.filterwarnings("ignore::rodjax.numerics.results.ModelWarning")
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hung", "driven", "pulled"])
def test_short_runs_end_well_or_with_a_code(kind):
    draw = np.random.default_rng(7)
    ended, faults = 0, []
    for i in range(100):
        scene = random_scene(draw, kind)
        try:
            state = rx.start(scene)
            end = log_uniform(draw, 1e-4, 1e-1)
            run = rx.adaptive_rollout(scene, state, end, max_steps=400, throw=False)
        except ValueError as error:
            if not OURS.match(str(error)):
                faults.append(f"{kind} {i}: {error}")
            continue
        if run.result != rx.Result.SUCCESS:
            continue
        ended += 1
        leaves = jax.tree.leaves(run.states)
        if not all(np.all(np.isfinite(leaf)) for leaf in leaves):
            faults.append(f"{kind} {i}: not finite with SUCCESS")
        if abs(float(run.final.time) - end) > 1e-9 * end:
            faults.append(f"{kind} {i}: ended at {run.final.time}, not {end}")
    assert not faults, "\n".join(faults)
    assert ended > 20
