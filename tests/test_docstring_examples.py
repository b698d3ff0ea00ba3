"""Every public name has an example in its docstring, and it runs."""

import dataclasses
import doctest
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rodjax as rx

# those that compile a program of their own
LONG = ["adaptive_rollout", "animate", "equilibrium", "jit", "SimulationError", "stability", "step"]
LONG += ["vibration", "check", "simulate"]
LONG += ["thermal_rollout", "ThermalRun", "thermal_step", "relaxation_times", "Averages"]
LONG += ["path", "branch", "critical", "CriticalPoint", "EquilibriumPath", "PathEnd"]
LONG += ["critical_curve"]
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name in LONG else name
    for name in rx.__all__
    if not inspect.ismodule(getattr(rx, name))
]


@pytest.fixture(scope="module")
def given() -> dict[str, object]:
    """What the reference's first page says that examples go on from."""
    section = rx.circular_section(0.01, youngs_modulus=1.2e8, shear_modulus=4e7, density=1500.0)
    rod = rx.straight_rod(1.0, 20, section, direction=(1, 0, 0))
    scene = rx.Scene(rod, rx.Clamped(), loads=(rx.Gravity((0, 0, -9.81)),))
    run = rx.rollout(scene, rx.start(scene), np.linspace(0.02, 0.2, 10))
    modules = {"rx": rx, "np": np, "jax": jax, "jnp": jnp, "dataclasses": dataclasses}
    return {**modules, "section": section, "rod": rod, "scene": scene, "run": run}


@pytest.mark.parametrize("name", NAMES)
def test_example_runs(name, given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(getattr(rx, name)) or ""
    assert "Example:\n" in text
    example = doctest.DocTestParser().get_doctest(text, dict(given), name, None, None)
    assert example.examples
    said: list[str] = []
    failed, _ = doctest.DocTestRunner(verbose=False).run(example, out=said.append)
    assert not failed, "".join(said)
