"""What a newcomer gives by mistake is answered with the argument's name and the mend."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import rodjax as rx
from rodjax.dynamics.adaptive import compile_adaptive_rollout


@pytest.fixture(autouse=True)
def unchecked():
    """Without the tests' run-time type checks, which would come before the package's own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


SECTION = rx.circular_section(0.01, 1e7, 4e6, 1000.0)
ROD = rx.straight_rod(1.0, 8, SECTION, direction=(1, 0, 0))
GRAVITY = rx.Gravity((0.0, 0.0, -9.81))
SCENE = rx.Scene(ROD, rx.Clamped(), loads=(GRAVITY,))
STATE = rx.placing(SCENE)
OTHER = rx.placing(rx.Scene(rx.straight_rod(1.0, 5, SECTION), rx.Clamped()))
FAILED = eqx.tree_at(lambda state: state.position, STATE, jnp.full((9, 3), jnp.nan))
RAMP = rx.Smooth([0.0, 1.0], [0.0, 1.0])
SHIFT = rx.Smooth([0.0, 1.0], [(0, 0, 0), (0, 0, 0.1)])


def scene(*ends, **parts):
    return rx.Scene(ROD, *ends, **parts)


def distributed(function):
    return scene(rx.Clamped(), loads=(rx.DistributedLoad(function),))


SLIPS = {
    # schedules
    "displacement tuple": (r"displacement: .*Smooth\(", lambda: rx.Clamped((0, 0, 0.1))),
    "displacement number": (r"displacement: .*Smooth\(", lambda: rx.Pinned(0.1)),
    "displacement of one": ("displacement: .* 3 components", lambda: rx.Clamped(RAMP)),
    "displacement function": (
        r"displacement: wrap .*Function\(",
        lambda: rx.Clamped(lambda t: jnp.zeros(3)),
    ),
    "displacement turn": ("displacement: give a schedule", lambda: rx.Clamped(rx.Turn(_X, RAMP))),
    "force tuple": (r"force: .*Constant\(", lambda: rx.PointLoad(-1, force=(0, 0, 1.0))),
    "force class": ("force: Constant is a class", lambda: rx.PointLoad(-1, force=rx.Constant)),
    "moment number": (r"moment: .*Constant\(", lambda: rx.PointLoad(-1, moment=1.0)),
    "angle number": (r"angle: .*\[rad\].*2 \* pi", lambda: rx.Turn(_X, 1.0)),
    "angle function": (r"angle: wrap .*Function\(", lambda: rx.Turn(_X, lambda t: t)),
    "angle of three": ("angle: .* one number", lambda: rx.Turn(_X, SHIFT)),
    "rotation without turn": (r"rotation: give Turn\(axis", lambda: rx.Clamped(rotation=RAMP)),
    "rotation number": (r"rotation: give Turn\(axis", lambda: rx.Slider(_X, rotation=3.0)),
    "rotation of a pin": ("rotation: a pinned end turns", lambda: rx.Pinned(None, RAMP)),
    "motion of a free end": ("displacement: a free end", lambda: rx.Free(SHIFT)),
    "function of numpy": ("function: .*jax.numpy", lambda: rx.Function(lambda t: np.array([t, 0]))),
    "function with if": ("function: .*jnp.where", lambda: rx.Function(lambda t: 1 if t > 0 else 0)),
    "function of nothing": ("function: .*got None", lambda: rx.Function(lambda t: None)),
    "function's own error": ("function: .*NameError", lambda: rx.Function(lambda t: undefined)),
    # scenes
    "class of an end": (r"first_end: Clamped is a class.*Clamped\(", lambda: scene(rx.Clamped)),
    "rod as an end": ("first_end: give an end", lambda: scene(ROD)),
    "class of a load": ("loads.0.: Gravity is a class", lambda: scene(loads=(rx.Gravity,))),
    "a load alone": (r"loads: give a tuple, for one load \(load,\)", lambda: scene(loads=GRAVITY)),
    "end as a load": ("loads.0.: give a load", lambda: scene(loads=(rx.Free(),))),
    "law for a contact": (r"contact: give Contact\(law", lambda: scene(contact=rx.Penalty(1e6))),
    "two rods": ("rod: give one rod", lambda: rx.Scene((ROD, ROD))),
    "section for a rod": ("rod: give one rod", lambda: rx.Scene(SECTION)),
    "gravity as a number": ("acceleration: must be three .*-9.81", lambda: rx.Gravity(9.81)),
    "current as a number": ("current: must be three", lambda: rx.MorisonDrag(1e3, 1, 0.1, 0.5)),
    # loads of the user's
    "numpy in a load": (
        "(?s:loads.0.*jax.numpy)",
        lambda: distributed(lambda p, s, m: np.maximum(m.position, 0) @ np.ones((3, 6))),
    ),
    "load of three columns": (
        r"loads.0.*\(9, 6\)",
        lambda: distributed(lambda p, s, m: jnp.zeros((len(s), 3))),
    ),
    # sections and rods
    "stiffness number": (r"stiffness: .*\(A1, A2, C\)", lambda: rx.Section(stiffness=1.0)),
    "stiffness of two": (r"stiffness: .*\(A1, A2, C\)", lambda: rx.Section(stiffness=(1.0, 1.0))),
    "compliance number": (
        "compliance: .*1/EA",
        lambda: rx.Section(stiffness=(1, 1, 1), compliance=1e-6),
    ),
    "curvature number": (
        "natural_curvature: give three components, .*twist",
        lambda: rx.straight_rod(1.0, 8, SECTION, natural_curvature=0.1),
    ),
    "profile with if": (
        "diameter: .*numpy.where",
        lambda: rx.straight_rod(
            1.0, 8, rx.circular_section(lambda s: 0.01 if s < 0.5 else 0.02, 1e7, 4e6, 1e3)
        ),
    ),
    "moments for a flag": (
        "rotary_inertia: must be True or False",
        lambda: rx.circular_section(0.01, 1e7, 4e6, 1e3, rotary_inertia=(1e-6, 1e-6, 2e-6)),
    ),
    "no section": ("section: give a Section", lambda: rx.straight_rod(1.0, 8, 0.01)),
    "class of a section": (
        "section: Section is a class",
        lambda: rx.straight_rod(1, 8, rx.Section),
    ),
    "elements without bound": (
        "elements: .*at most",
        lambda: rx.straight_rod(1.0, 10**12, SECTION),
    ),
    "curve by its angle": (
        "curve: must be parametrised by arc length.* give its points",
        lambda: rx.curved_rod(lambda s: [jnp.cos(s), 2 * jnp.sin(s), 0.0], 6.0, 8, SECTION),
    ),
    # starts and runs
    "start of a rod": ("scene: give a Scene", lambda: rx.start(ROD)),
    "start of another grid": (
        r"position: expected shape \(9, 3\)",
        lambda: rx.start(SCENE, position=np.zeros((5, 3))),
    ),
    "complex start": ("velocity: .*real", lambda: rx.start(SCENE, velocity=1j * np.ones((9, 3)))),
    "times of a start": ("time: must be one", lambda: rx.start(SCENE, time=[0.0, 1.0])),
    "no state": ("state: give a State, of start", lambda: rx.adaptive_rollout(SCENE, 1.0)),
    "no state of a rollout": ("state: give a State", lambda: rx.rollout(SCENE, np.ones(3))),
    "rod for a state": ("state: give a State", lambda: rx.adaptive_rollout(SCENE, ROD, 1.0)),
    "none for a state": ("state: give a State", lambda: rx.equilibrium(SCENE, None)),
    "no time": ("end_time: give the time", lambda: rx.adaptive_rollout(SCENE, STATE)),
    "times as a number": (r"times: .*linspace", lambda: rx.rollout(SCENE, STATE, 1.0)),
    "no times": (r"times: .*linspace", lambda: rx.rollout(SCENE, STATE)),
    "time of the state among the times": (
        r"times: the first step must end after the state's time 0, .*\(times\[1:\]\)",
        lambda: rx.rollout(SCENE, STATE, np.linspace(0.0, 0.1, 3)),
    ),
    "times that fall": (
        "times: must increase, but 0.1 comes after 0.2",
        lambda: rx.rollout(SCENE, STATE, [0.2, 0.1]),
    ),
    "scene and state exchanged": ("scene: give a Scene", lambda: rx.rollout(STATE, SCENE, [0.1])),
    "class of a method": (
        "method: GeneralizedAlpha is a class",
        lambda: rx.rollout(SCENE, STATE, [0.1], rx.GeneralizedAlpha),
    ),
    "control for a method": (
        "method: give GeneralizedAlpha",
        lambda: rx.adaptive_rollout(SCENE, STATE, 1.0, rx.StepControl()),
    ),
    "node beyond the last": (
        "node: a rod of 8 elements has the nodes 0 to 8, or -9 to -1, got 9",
        lambda: scene(rx.Clamped(), loads=(rx.PointLoad(9, rx.Constant((0, 0, 1.0))),)),
    ),
    "cut-off as long as the rod": (
        "cutoff: points within 1.5 of each other along the rod never interact",
        lambda: scene(contact=rx.Contact(rx.Penalty(1e6), segments=40, cutoff=1.0)),
    ),
    "state of another grid": (
        r"state: is one of 6 nodes, .* 9.*regrid\(state, rod\)",
        lambda: rx.rollout(SCENE, OTHER, [0.1]),
    ),
    "other grid at rest": ("state: is one of 6 nodes", lambda: rx.equilibrium(SCENE, OTHER)),
    "other grid's modes": ("state: is one of 6 nodes", lambda: rx.vibration(SCENE, OTHER)),
    "other grid's stability": ("state: is one of 6 nodes", lambda: rx.stability(SCENE, OTHER)),
    **{
        f"failed state in {name}": ("state: holds no numbers.*failed.*result", function)
        for name, function in {
            "rollout": lambda: rx.rollout(SCENE, FAILED, [0.1]),
            "adaptive_rollout": lambda: rx.adaptive_rollout(SCENE, FAILED, 0.1),
            "equilibrium": lambda: rx.equilibrium(SCENE, FAILED, throw=False),
            "stability": lambda: rx.stability(SCENE, FAILED),
            "vibration": lambda: rx.vibration(SCENE, FAILED),
        }.items()
    },
    "load steps as a text": (
        "load_steps: must be a whole number",
        lambda: rx.equilibrium(SCENE, STATE, load_steps="a"),
    ),
    "half a load step": (
        "load_steps: must be a whole number",
        lambda: rx.equilibrium(SCENE, STATE, load_steps=2.5),
    ),
    "tolerance as a text": (
        "tolerance: must be one real number",
        lambda: rx.equilibrium(SCENE, STATE, tolerance="a"),
    ),
    "chunk as a text": (
        "chunk: must be a whole number",
        lambda: rx.adaptive_rollout(SCENE, STATE, 1.0, chunk="a"),
    ),
    "part of a chunk": (
        "chunk: must be a whole number",
        lambda: rx.adaptive_rollout(SCENE, STATE, 1.0, chunk=2.5),
    ),
    "no step": (
        "max_steps: must be a whole number of at least 1",
        lambda: rx.adaptive_rollout(SCENE, STATE, 1.0, max_steps=0),
    ),
    "chunk to compile": (
        "chunk: must be a whole number",
        lambda: compile_adaptive_rollout(SCENE, STATE, chunk=0),
    ),
    "method to compile in the state's place": (
        "state: .*give a State",
        lambda: compile_adaptive_rollout(SCENE, rx.GeneralizedAlpha()),
    ),
    "method to compile": (
        r"method: .*GeneralizedAlpha\(",
        lambda: compile_adaptive_rollout(SCENE, STATE, rx.GeneralizedAlpha),
    ),
    "chosen steps in traced code": (
        "scene, state: adaptive_rollout cannot be traced; replay its times by rollout",
        lambda: jax.jit(lambda t: rx.adaptive_rollout(SCENE, STATE, t))(1.0),
    ),
    "gradient of chosen steps": (
        "scene, state: adaptive_rollout cannot be traced",
        lambda: jax.grad(
            lambda x: rx.adaptive_rollout(
                SCENE, dataclasses.replace(STATE, position=x * STATE.position), 1.0
            ).times[-1]
        )(1.0),
    ),
    "half waves as a text": (
        "modes: must be a whole number of at least 1 and at most 4, got 'a'; the rod has 8",
        lambda: rx.imperfect(ROD, modes="a"),
    ),
    "imperfection as a text": (
        "fraction: must be one real number",
        lambda: rx.imperfect(ROD, "a"),
    ),
    "seed as a text": ("seed: must be a whole number", lambda: rx.imperfect(ROD, seed="a")),
    "scene for a rod": ("rod: give a rod", lambda: rx.imperfect(SCENE)),
    "lanes as a text": (
        "per_device: must be a whole number",
        lambda: rx.sweep.sweep(lambda x: x, {"x": np.ones(2)}, "none.h5", per_device="a"),
    ),
    "states of a run": (
        "state: holds many states",
        lambda: rx.rollout(SCENE, jax.tree.map(lambda x: jnp.stack([x, x]), STATE), [0.1]),
    ),
}
_X = (1.0, 0.0, 0.0)


@pytest.mark.parametrize("slip", SLIPS)
def test_slips_are_answered_with_name_and_mend(slip):
    match, build = SLIPS[slip]
    with pytest.raises(ValueError, match=f"^({match})"):
        build()


def test_what_is_meant_is_taken():
    as_list = rx.Clamped(rx.Function(lambda t: [0, 0, t * t]))
    np.testing.assert_array_equal(as_list.displacement(jnp.asarray(3.0)), [0.0, 0.0, 9.0])
    assert rx.straight_rod(1.0, 8.0, SECTION).elements == 8
    assert int(rx.GeneralizedAlpha(max_iterations=3.0).max_iterations) == 3
    one = rx.straight_rod(1.0, 8, rx.circular_section(lambda s: 0.01, 1e7, 4e6, 1e3))
    np.testing.assert_array_equal(one.diameter, np.full(8, 0.01))
    plain = rx.curved_rod(lambda s: [np.cos(s), np.sin(s), 0.0], 2.0, 8, SECTION)
    traced = rx.curved_rod(lambda s: jnp.array([jnp.cos(s), jnp.sin(s), 0.0]), 2.0, 8, SECTION)
    np.testing.assert_allclose(plain.position, traced.position, atol=1e-10)
