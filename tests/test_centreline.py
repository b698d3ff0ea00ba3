"""Measured centrelines: faults are named by their lines, mended ones are the curve meant."""

import inspect

import numpy as np
import pytest
from helpers import UNIT_SECTION

import rodjax as rx

# as a user without a type checker meets it
centreline = inspect.unwrap(rx.centreline)

TURNS = np.linspace(0.0, 1.5, 61)


def helix(t):
    """Radius 1 and pitch 2: curvature 1/(1 + 1/pi^2), along 2 pi sqrt(1 + 1/pi^2) a turn."""
    angle = 2 * np.pi * np.asarray(t)
    return np.stack([np.cos(angle), np.sin(angle), 2 * np.asarray(t)], -1)


LENGTH = 1.5 * 2 * np.pi * np.sqrt(1 + 1 / np.pi**2)


def written(path, rows, heading="t,x [mm],y [mm],z [mm]", divider=","):
    lines = [divider.join("" if np.isnan(v) else repr(float(v)) for v in row) for row in rows]
    path.write_text("\n".join(([heading] if heading else []) + lines) + "\n")
    return path


@pytest.fixture
def rows():
    """A helix in millimetres, with its turns before."""
    return np.concatenate([TURNS[:, None], 1e3 * helix(TURNS)], 1)


def test_a_table_becomes_the_rod_that_was_measured(rows, tmp_path):
    line = centreline(written(tmp_path / "a.csv", rows), parameter="t", factor=1e-3)
    assert line.report == ("multiplied by 0.001, of mm",)
    np.testing.assert_allclose(line.points, helix(TURNS), atol=1e-12)
    np.testing.assert_allclose(line.length, LENGTH, rtol=2e-6)
    np.testing.assert_allclose(line.arc_length, LENGTH * TURNS / 1.5, rtol=1e-4, atol=1e-5)
    rod = line.rod(60, UNIT_SECTION, first_director=(0, 0, 1))
    np.testing.assert_allclose(np.sum(rod.length), LENGTH, rtol=2e-6)
    np.testing.assert_allclose(rod.position[-1], helix(1.5), atol=1e-2)  # second order in ds
    bend = np.linalg.norm(rod.natural_curvature[5:-5, :2], axis=1)
    np.testing.assert_allclose(bend, 1 / (1 + 1 / np.pi**2), rtol=5e-3)
    assert str(line).splitlines() == [
        f"a centreline of 61 points, {LENGTH:.6g} long", "  multiplied by 0.001, of mm",
    ]  # fmt: skip
    assert "in mm, as the table says" in str(centreline(tmp_path / "a.csv"))


@pytest.mark.parametrize(
    ("heading", "divider"),
    [("x,y,z", ","), ("", ","), ("", " "), ("# x y z", " "), ("Z; y ;x", ";"), ("x\ty\tz", "\t")],
)
def test_tables_come_in_many_forms(heading, divider, tmp_path):
    points = helix(TURNS)
    given = points[:, ::-1] if heading.startswith("Z") else points
    path = written(tmp_path / "a.txt", given, heading, divider)
    if divider == ";":
        path.write_text("\ufeff" + path.read_text().replace(".", ","))
    np.testing.assert_allclose(centreline(path).points, points, atol=1e-15)
    np.testing.assert_array_equal(centreline(points).points, points)


def test_columns_are_chosen(rows, tmp_path):
    path = written(tmp_path / "a.csv", rows, "tip,a,b,c")
    with pytest.raises(ValueError, match="which are x, y and z; there are 'tip', 'a', 'b', 'c'"):
        centreline(path)
    for columns in (("a", "b", "c"), (1, 2, 3)):
        np.testing.assert_allclose(centreline(path, columns=columns).points, rows[:, 1:])
    flat = centreline(path, columns=("a", "b"), factor=1e-3)
    assert flat.report == ("multiplied by 0.001", "in the plane z = 0")
    np.testing.assert_allclose(flat.points[:, :2], helix(TURNS)[:, :2], atol=1e-12)
    with pytest.raises(ValueError, match="no one column 'd'; there are 'tip', 'a'"):
        centreline(path, columns=("a", "b", "d"))


def test_missing_numbers_are_named_and_left_out(rows, tmp_path):
    rows[[3, 17], 2] = np.nan
    path = written(tmp_path / "a.csv", rows)
    with pytest.raises(ValueError, match="lines 5, 19: numbers are missing.*drop_missing=True"):
        centreline(path)
    line = centreline(path, drop_missing=True, factor=1e-3)
    assert line.report[-1] == "left out, for want of numbers: lines 5, 19"
    np.testing.assert_allclose(line.points, np.delete(helix(TURNS), [3, 17], 0), atol=1e-12)
    np.testing.assert_allclose(line.length, LENGTH, rtol=1e-4)
    path.write_text(path.read_text().replace(",,", ",lost,", 1))
    with pytest.raises(ValueError, match=r"line 5, column 'y \[mm\]': 'lost' is no number"):
        centreline(path)


def test_repeated_points_are_left_out(rows, tmp_path):
    again = np.insert(rows, 8, rows[7], 0)
    line = centreline(written(tmp_path / "a.csv", again), factor=1e-3)
    assert line.report[-1] == "left out, on the point before: line 10"
    np.testing.assert_allclose(line.points, helix(TURNS), atol=1e-12)
    with pytest.raises(ValueError, match="all points lie in one place"):
        centreline(np.ones((4, 3)))


def test_a_falling_parameter_reverses(rows, tmp_path):
    line = centreline(written(tmp_path / "a.csv", rows[::-1]), parameter="t", factor=1e-3)
    assert line.report[-1] == "reversed: t falls from first to last"
    np.testing.assert_allclose(line.points, helix(TURNS), atol=1e-12)
    back = centreline(helix(TURNS), reverse=True)
    np.testing.assert_array_equal(back.points, helix(TURNS)[::-1])
    assert back.report == ("reversed, as asked",)


def test_rows_out_of_order_are_named_and_sorted(rows, tmp_path):
    rows[[10, 20]] = rows[[20, 10]]
    path = written(tmp_path / "a.csv", rows, "s,x,y,z")  # whose column s is found by itself
    with pytest.raises(ValueError, match=r"lines 13, 22: out of order, as of line 13 s = 0.275"):
        centreline(path)
    line = centreline(path, sort=True, factor=1e-3)
    assert line.report[-1] == "sorted by s: out of order were lines 13, 22"
    np.testing.assert_allclose(line.points, helix(TURNS), atol=1e-12)
    twice = rows.copy()
    twice[31, 0] = twice[30, 0]
    with pytest.raises(ValueError, match="line 33: apart from the point before, but of the same s"):
        centreline(written(path, twice, "s,x,y,z"), sort=True)
    with pytest.raises(ValueError, match=r"points\[12\], points\[13\]: there the line turns back"):
        centreline(
            np.concatenate([helix(TURNS)[:11], helix(TURNS)[[13, 12]], helix(TURNS)[14:22][::-1]])
        )


def test_jumps_are_named(rows, tmp_path):
    short = np.delete(rows, np.arange(20, 35), 0)
    path = written(tmp_path / "a.csv", short)
    with pytest.raises(ValueError, match=r"line 22: as far as .* give largest_gap=2.08"):
        centreline(path, factor=1e-3)
    assert len(centreline(path, factor=1e-3, largest_gap=2.08).points) == 46


def test_resampled_points_lie_on_the_curve():
    uneven = 1.5 * np.linspace(0, 1, 120) ** 1.3
    line = centreline(helix(uneven), points=50)
    assert line.report == ("120 points resampled to 50, equally spaced",)
    np.testing.assert_allclose(line.points, helix(np.linspace(0, 1.5, 50)), atol=1e-3)
    many = centreline(helix(np.linspace(0, 1.5, 5001)))
    assert len(many.points) == 2000 and "at most 2000" in many.report[0]
    np.testing.assert_allclose(many.length, LENGTH, rtol=1e-9)


def test_noise_is_smoothed():
    noisy = helix(np.linspace(0, 1.5, 400)) + 0.02 * np.random.default_rng(1).normal(size=(400, 3))
    with pytest.raises(ValueError, match="turns back.*noise="):
        centreline(noisy)
    line = centreline(noisy, noise=0.02, points=80)
    off = np.linalg.norm(line.points - helix(np.linspace(0, 1.5, 80)), axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.02
    bend = np.linalg.norm(line.rod(40, UNIT_SECTION).natural_curvature[:, :2], axis=1)
    np.testing.assert_allclose(np.mean(bend[3:-3]), 1 / (1 + 1 / np.pi**2), rtol=0.05)
    moved = float(line.report[-1].split()[5])
    np.testing.assert_allclose(moved, np.sqrt(3) * 0.02, rtol=0.1)


def test_one_of_many_times_is_picked(tmp_path):
    both = [np.c_[np.full(61, t), TURNS, (1 + t) * helix(TURNS)] for t in (0.0, 0.1 + 0.2)]
    path = written(tmp_path / "a.csv", np.concatenate(both), "time [s],s,x,y,z")
    with pytest.raises(ValueError, match="line 63: out of order.*only= one of several"):
        centreline(path)
    np.testing.assert_allclose(centreline(path, only={"time": 0.3}).points, 1.3 * helix(TURNS))
    with pytest.raises(ValueError, match=r"no row has time = 2.0; there are \[0.0, 0.3"):
        centreline(path, only={"time": 2.0})


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        (np.zeros((4, 5)), {}, r"source: give the path of a table, or points \(k, 3\)"),
        ("nothing.csv", {}, "nothing.csv"),
        (helix(TURNS), {"factor": 0.0}, "factor: must be positive"),
        (helix(TURNS), {"points": 1}, "points: must be a whole number"),
        (helix(TURNS), {"sort": True}, "sort: say by what"),
        (helix(TURNS), {"parameter": TURNS[1:]}, "parameter: give a number a point, 61"),
        (helix(TURNS)[:1], {}, "at least 2 points"),
    ],
)
def test_what_does_not_fit_is_refused(source, options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        centreline(source, **options)
