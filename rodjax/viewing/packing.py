"""Arrays as text in a page: single precision or 16 bits, little-endian, in base64."""

import base64
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

# Of 16 bits, the last of which stands for what is not a number.
LEVELS, MISSING = 65534, 65535


class Levels(NamedTuple):
    """Values as levels of 16 bits between the least and the greatest.

    Attributes:
        text: of the levels.
        low, high: what 0 and `LEVELS` stand for.
    """

    text: str
    low: float
    high: float


def as_text(values: Shaped[np.ndarray, "..."], kind: str) -> str:
    """An array of a kind of numpy, such as "<f4"."""
    return base64.b64encode(np.ascontiguousarray(values, np.dtype(kind)).tobytes()).decode()


def from_text(text: str, kind: str) -> np.ndarray:
    """What `as_text` was given, flat."""
    return np.frombuffer(base64.b64decode(text), np.dtype(kind))


def frames_as_text(quaternions: Float[np.ndarray, "k nodes 4"]) -> str:
    """Unit quaternions in 16 bits a component: good to 2e-5 rad."""
    return as_text(np.round(32767 * quaternions), "<i2")


def levels(values: Float[np.ndarray, "k n"], low: float, high: float) -> Levels:
    """Values in 16 bits from low to high."""
    with np.errstate(invalid="ignore"):
        level = np.round(LEVELS * (np.clip(values, low, high) - low) / (high - low))
    level = np.where(np.isfinite(values), np.nan_to_num(level), MISSING)
    return Levels(as_text(level, "<u2"), low, high)


def from_levels(packed: Levels) -> np.ndarray:
    """The values, flat."""
    level = from_text(packed.text, "<u2").astype(float)
    values = packed.low + (packed.high - packed.low) * level / LEVELS
    return np.where(level == MISSING, np.nan, values)
