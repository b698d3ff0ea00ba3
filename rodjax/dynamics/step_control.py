"""How an adaptive run chooses its steps: by the local error of the last."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rodjax.dynamics.stepping import StepInfo
from rodjax.inputs.validation import as_float, check_positive, check_scalar, given
from rodjax.numerics.rotations import logarithm
from rodjax.rods.rod import Rod
from rodjax.rods.state import State
from rodjax.rods.strains import element_rotation


class StepControl(eqx.Module):
    """How the adaptive rollout chooses its steps.

    A step is accepted if its local error is at most `relative` times the step's own increment
    plus `absolute` times the size of the deformation, both for displacements (in tenths of the
    rod's length) and for rotations of the tangent [rad]. The size is the rod's total bending
    angle, at most 1 rad: so a growing mode is followed from its imperfection on, while vibrations
    that are small beside a developed shape are not resolved. Rotations are watched because a
    straight rod about to buckle moves its ends in second order only; twist, whose waves are fast
    and harmless, has a wide absolute tolerance of its own.

    Args:
        relative, absolute: tolerances.
        twisting: absolute tolerance of the rotation about the tangent [rad].
        first_step, max_step, min_step: [time]; max_step None means a hundredth of the run,
            first_step None a thousandth of max_step, min_step None 1e-14 of it (1e-9 in single
            precision): a rough rod without inertia settles in tiny steps first.

    Example:
        >>> careful = rx.StepControl(relative=1e-3, absolute=2.5e-4, max_step=0.01)
    """

    relative: Float[Array, ""] = eqx.field(converter=as_float, default=0.01)
    absolute: Float[Array, ""] = eqx.field(converter=as_float, default=2.5e-3)
    max_step: float | Array | None = None
    first_step: float | Array | None = None
    min_step: float | Array | None = None
    twisting: Float[Array, ""] = eqx.field(converter=as_float, default=0.05)

    def __check_init__(self):
        tolerances = {name: getattr(self, name) for name in ("relative", "absolute", "twisting")}
        steps = given(max_step=self.max_step, first_step=self.first_step, min_step=self.min_step)
        check_scalar(**tolerances, **steps)
        check_positive(**tolerances, **steps)


class Control(NamedTuple):
    """Memory of the step control.

    Attributes:
        dt: step to try next [s].
        growth: by what factor it may grow after the next accepted step.
        max_step, min_step: bounds of the step [s].
        landing: steps accepted since the end of the run came near; -1: it has not.
        next_dt, next_growth: `dt` and `growth` as they were then.
    """

    dt: Float[Array, ""]  # step to try next
    growth: Float[Array, ""]  # how much it may grow after the next accepted step
    max_step: Float[Array, ""]  # bounds of the step; those left to the rollout depend on its span,
    min_step: Float[Array, ""]  # so a resumed run takes them from here
    # A run ends exactly on its end time, by steps that another end would have made otherwise.
    landing: Int[Array, ""] | int = -1  # accepted since the end came near; -1: it has not
    next_dt: Float[Array, ""] | None = None  # `dt` and `growth` as they were then: a resumed run
    next_growth: Float[Array, ""] | None = None  # goes on with them, from the state of then


def tolerances_of(control: StepControl, dtype) -> tuple[Array, ...]:
    """Relative, absolute and twisting tolerance in the run's precision."""
    return tuple(
        jnp.asarray(t, dtype) for t in (control.relative, control.absolute, control.twisting)
    )


def begin(control: StepControl, span: float, dtype, resume: Control | None = None) -> Control:
    """Memory to start with: that of the run resumed, and what `control` says anew."""
    as_array = lambda x: jnp.asarray(x, dtype)
    max_step = span / 100 if resume is None else resume.max_step
    max_step = as_array(max_step if control.max_step is None else control.max_step)
    smallest = 1e-14 if jnp.finfo(dtype).eps < 1e-12 else 1e-9
    min_step = smallest * max_step if resume is None else resume.min_step
    min_step = as_array(min_step if control.min_step is None else control.min_step)
    if resume is None:
        dt = 1e-3 * max_step if control.first_step is None else control.first_step
        growth = 2.0
    elif int(resume.landing) < 0:
        dt, growth = resume.dt, resume.growth
    else:
        dt, growth = resume.next_dt, resume.next_growth
    dt, growth = as_array(dt), as_array(growth)
    return Control(dt, growth, max_step, min_step, jnp.asarray(-1, jnp.int32), dt, growth)


def near_end(control: Control, left: Float[Array, ""]) -> Control:
    """The control with a note of itself if the run's end is nearer than two steps."""
    assert control.next_dt is not None and control.next_growth is not None  # `begin` gives both
    now = (control.landing < 0) & (left < 2 * control.dt)
    return control._replace(
        landing=jnp.where(now, 0, control.landing).astype(jnp.int32),
        next_dt=jnp.where(now, control.dt, control.next_dt),
        next_growth=jnp.where(now, control.growth, control.next_growth),
    )


def error_ratio(
    tolerances: tuple[Array, ...], rod: Rod, before: State, info: StepInfo
) -> Float[Array, ""]:
    """Local error of a step over the largest allowed: at most 1 is accepted."""
    relative, absolute, twisting = tolerances
    dtype = before.position.dtype
    length = jnp.sum(rod.length)
    phi = logarithm(element_rotation(rod, before.quaternion))[:, :2]
    bent = jnp.sum(jnp.sqrt(jnp.sum(phi**2, 1) + jnp.finfo(dtype).tiny))
    bent = jnp.clip(bent, 1e-6, 1.0)
    # of positions, over an element's length in rotations: in single precision this noise would
    # else be taken for the error of a small step, and drive it to zero
    rounding = 10 * jnp.finfo(dtype).eps
    allowed = lambda growth, unit, floor: relative * growth + absolute * unit + floor
    position = allowed(info.growth_position, 0.1 * bent * length, rounding * length)
    bending = allowed(info.growth_bending, bent, rounding * rod.elements)
    ratios = [
        info.error_position / position,
        info.error_bending / bending,
        info.error_twisting / (relative * info.growth_twisting + twisting),
    ]
    # the shock of a new constraint is not resolved but damped: keep the step through it
    return jnp.where(info.settling, 0.5, jnp.max(jnp.stack(ratios)))


def choose(
    control: Control,
    dt: Float[Array, ""],
    error: Float[Array, ""],
    info: StepInfo,
    on_mark: Bool[Array, ""],
) -> tuple[Bool[Array, ""], Control]:
    """Whether a step of size `dt` is accepted, and the control for the next.

    Args:
        error: see `error_ratio`.
        on_mark: the step was shortened to end on a mark, which says nothing of the next.
    """
    failed = info.result != 0
    error = jnp.where(failed, 8.0, jnp.maximum(error, 1e-6))
    accept = ~failed & (error <= 1.0)
    factor = jnp.clip(0.85 * error ** (-1 / 3), 0.25, control.growth)
    # many iterations: near the limit of what Newton can do, so do not ask for more
    factor = jnp.where(info.iterations > 8, jnp.minimum(factor, 0.8), factor)
    # a dead band: every jump of the step makes forces first order for a while
    factor = jnp.where(accept & (factor > 0.9) & (factor < 1.2), 1.0, factor)
    factor = jnp.where(accept, factor, jnp.minimum(factor, 0.7))
    # growth is forbidden after a failure and given back gradually
    growth = jnp.where(accept, jnp.minimum(control.growth * 1.06, 2.0), 1.2)
    growth = jnp.where(failed, 1.0, growth).astype(dt.dtype)
    trial = jnp.where(accept & on_mark, jnp.maximum(dt, control.dt), dt)
    dt = jnp.minimum(trial * factor, control.max_step)
    landing = control.landing + (accept & (control.landing >= 0)).astype(jnp.int32)
    return accept, control._replace(dt=dt, growth=growth, landing=landing)
