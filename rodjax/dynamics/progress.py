"""A line that says how far a run has come, where somebody can see it."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rodjax.inputs.validation import shown

Progress = bool | Callable[[float, int], None] | None


@contextlib.contextmanager
def showing(
    progress: Progress, begun: float, until: float
) -> Iterator[Callable[[float, int], None]]:
    """A function of the time reached and the steps made, which shows them.

    Args:
        progress: None shows them where stderr is a terminal, and in notebooks; True and False do
            and do not; a function of both is called instead.
        begun, until: times at which the run begins and ends.
    """
    if callable(progress):
        yield progress
        return
    if not (_seen() if progress is None else progress):
        yield lambda time, steps: None
        return
    from tqdm import tqdm  # not with the package: it takes a while

    line = "{percentage:3.0f}%|{bar:30}| {desc} [{elapsed}]"
    words = f"t = {begun:.4g} of {until:.4g}"
    with tqdm(total=until - begun, desc=f"{words}, compiling", bar_format=line) as bar:

        def show(time: float, steps: int) -> None:
            if time - begun > 0.02 * (until - begun):  # before it would be a guess
                bar.bar_format = line.replace("{elapsed}", "{elapsed}<{remaining}")
            bar.set_description_str(f"t = {time:.4g} of {until:.4g}, {steps} steps", refresh=False)
            # in single precision the end may be a little later
            bar.update(min(time, until) - begun - bar.n)

        yield show
        bar.refresh()


def check_progress(progress) -> None:
    """Raise ValueError unless it is what `showing` takes."""
    if not (progress is None or isinstance(progress, bool) or callable(progress)):
        raise ValueError(
            "progress: give True, False or a function of the time and the steps, got"
            f" {shown(progress)}"
        )


def _seen() -> bool:
    """Whether somebody looks on: stderr is a terminal, or a notebook shows it."""
    if sys.stderr is not None and sys.stderr.isatty():
        return True
    interactive = sys.modules.get("IPython")
    return interactive is not None and hasattr(interactive.get_ipython(), "kernel")
