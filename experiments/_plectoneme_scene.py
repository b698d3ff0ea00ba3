"""The rod of `plectoneme.py`, its drive with holds, its contact, and its end on another grid."""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

import rodjax as rx

LENGTH, RADIUS = 0.5, 1.55e-3  # [m]
YOUNGS_MODULUS, DENSITY = 1.3e6, 1200.0  # [Pa], [kg/m^3]; Poisson's ratio 1/2
NEARER = 0.3  # ends, of the length
RATE = 0.25  # [turns/s]
HOLD = 10.0  # after each stage [s]
SEED_CURVATURE = 0.02  # natural, about a_1 [1/m]
DRAG = (0.05, 0.05, 1e-7)  # normal, tangential [N s/m^2], rotational [N s]
RELAXATION = 1e-3  # of the contact, which takes the bounces from strands that meet [s]
MAX_STEP = 0.2  # [s]
AXIS = (0.0, 0.0, 1.0)


class Size(NamedTuple):
    """How large the experiment is."""

    elements: int
    turns: tuple[float, ...]  # at which the drive is held
    force: float  # between crossing strands [N], see `Contact.solid`
    indentation: float  # at this force [D]
    segments: int  # of the contact


FULL = Size(400, (8.0, 12.0, 16.0, 20.0), 0.1, 0.03, 640)
QUICK = Size(120, (10.0,), 0.05, 0.1, 240)


def arch(elements: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and frames of a planar arch between clamps, its tangents at angles a sin(2 pi s/L)."""
    step = LENGTH / elements
    wave = np.sin(2 * np.pi * np.arange(elements + 1) / elements)
    wave[[0, -1]] = 0.0  # ends along the axis, to the last bit

    def nodes(amplitude):
        angle = 0.5 * amplitude * (wave[1:] + wave[:-1])
        chords = step * np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], -1)
        return np.concatenate([np.zeros((1, 3)), np.cumsum(chords, 0)])

    chord = (1 - NEARER) * LENGTH
    amplitude = brentq(lambda a: nodes(a)[-1, 2] - chord, 0.1, 2.4)
    half, none = 0.5 * amplitude * wave, np.zeros_like(wave)
    return nodes(amplitude), np.stack([np.cos(half), none, np.sin(half), none], -1)


def rod(elements: int) -> rx.Rod:
    """The rod, straight but for its seed of curvature, placed as an arch."""
    section = rx.circular_section(
        2 * RADIUS, YOUNGS_MODULUS, shear_modulus=YOUNGS_MODULUS / 3, density=DENSITY
    )
    seed = (SEED_CURVATURE, 0.0, 0.0)
    straight = rx.straight_rod(LENGTH, elements, section, direction=AXIS, natural_curvature=seed)
    position, quaternion = arch(elements)
    return dataclasses.replace(straight, position=position, quaternion=quaternion)


def holds(turns: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Times at which the drive stops and goes on [s], one row a stage; and the knots of both."""
    wound = np.array(turns) / RATE
    stops = wound + HOLD * np.arange(len(turns))
    rows = np.stack([stops, stops + HOLD], -1)
    return rows, np.repeat(turns, 2)


def contact(whole: rx.Rod, size: Size) -> rx.Contact:
    """Contact of solid strands, on segments short beside the bends of a ply.

    Contact points lie on chords between the segments' ends, inside of a bend kappa = sin^2(theta)/R
    by kappa l^2/12 on average. So the strands are kept kappa l^2/6 farther apart, and since that
    goes with the angle too, M is l^2 sin^2(theta)/(12 R^2 cos 2 theta) above the theory's (half a
    hundredth here, 4 % with as few segments as `Contact.solid` chooses) and T about as much.
    """
    solid = rx.Contact.solid(whole, size.force, indentation=size.indentation, relaxation=RELAXATION)
    points = int(np.ceil(solid.segments * solid.points_per_segment / size.segments))
    return dataclasses.replace(solid, segments=size.segments, points_per_segment=points)


def scene(size: Size) -> rx.Scene:
    """The rod between its clamps, that of s = 0 turned so that Lk grows."""
    rows, turns = holds(size.turns)
    # and one hold more, for `settled`
    times = np.concatenate([[0.0], rows.ravel(), [rows[-1, 1] + HOLD]])
    angle = rx.PiecewiseLinear(times, -2 * np.pi * np.concatenate([[0.0], turns, turns[-1:]]))
    whole = rod(size.elements)
    return rx.Scene(
        whole,
        first_end=rx.Clamped(rotation=rx.Turn(AXIS, angle)),
        last_end=rx.Clamped(),
        loads=(rx.LinearDrag(*DRAG),),
        contact=contact(whole, size),
    )


def settled(whole: rx.Scene, state, elements: int, size: Size) -> tuple[rx.Scene, rx.Run]:
    """The state at rest on another grid, with contact segments in proportion."""
    segments = round(size.segments * elements / size.elements)
    other = scene(size._replace(elements=elements, segments=segments))
    new = rx.regrid(state, other.rod)
    first = rx.start(
        other,
        position=new.position,
        quaternion=new.quaternion,
        velocity=new.velocity,
        angular_velocity=new.angular_velocity,
        time=new.time,
    )
    control = rx.StepControl(max_step=MAX_STEP, first_step=0.01 * MAX_STEP)
    run = rx.adaptive_rollout(other, first, float(state.time) + HOLD, control=control, throw=False)
    return other, run
