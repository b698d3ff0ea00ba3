"""Rods dropped on a floor, one on the other, with friction: how they come to rest, and what it costs.

    python experiments/pile.py [--rods K] [--elements N] [--seconds T] [--quick] [--out DIR]

Rods of rubber (0.5 m long, 5 mm thick) lie level above each other, each turned by the golden angle
against the one below, and fall on a floor. They rub on it and on each other by Coulomb's law with
the same coefficient. What the run cost is printed with what came of it: heights, places that touch,
the speed left, and the ledger of energy. Writes DIR/pile.png and DIR/summary.json; the exit status
is 0 if the run came to its end.
"""

import argparse
import json
import time
from pathlib import Path

import _settings  # noqa: F401 (first)
import jax
import matplotlib.pyplot as plt
import numpy as np

import rodjax as rx
from rodjax import energy, measures

LENGTH, DIAMETER = 0.5, 5e-3  # [m]
YOUNGS_MODULUS, DENSITY = 2e6, 1200.0  # [Pa], [kg/m^3]
FRICTION = 0.4
GRAVITY = 9.81
SLIP = 1e-3  # below which surfaces creep [m/s]
APART = 1.6  # heights between the rods, over the diameter
GOLDEN = np.pi * (3 - np.sqrt(5))
WEIGHT = DENSITY * np.pi / 4 * DIAMETER**2 * GRAVITY  # per length [N/m]


def rods(count: int, elements: int) -> tuple[rx.Rod, ...]:
    """Level, above each other, their middles a little apart."""
    section = rx.circular_section(DIAMETER, YOUNGS_MODULUS, YOUNGS_MODULUS / 3, density=DENSITY)
    placed = []
    for i in range(count):
        angle = GOLDEN * i
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        middle = np.array([0.02 * np.cos(7 * i), 0.02 * np.sin(5 * i), 0.0])
        middle[2] = DIAMETER * (1.0 + APART * i)
        origin = middle - 0.5 * LENGTH * along
        placed.append(
            rx.straight_rod(LENGTH, elements, section, direction=tuple(along), origin=tuple(origin))
        )
    return tuple(placed)


def scene(count: int, elements: int) -> rx.Scene:
    """The rods above a floor, which carries the weight of all of them at a fiftieth of a diameter."""
    placed = rods(count, elements)
    floor = rx.Obstacle(
        rx.Plane((0, 0, 0), (0, 0, 1)),
        50 * WEIGHT * count / DIAMETER,
        rx.SlidingFriction(FRICTION, SLIP),
        relaxation=2e-3,
    )
    contact = rx.Contact.solid(
        placed[0],
        WEIGHT * LENGTH * count,
        indentation=0.1,
        relaxation=2e-3,
        friction=rx.SlidingFriction(FRICTION, SLIP),
        segments=count * elements,
    )
    loads = (rx.Gravity((0, 0, -GRAVITY)), floor)
    return rx.Scene(rods=placed, loads=loads, contact=contact)
