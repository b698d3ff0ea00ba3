"""The notebooks beside this folder become pages of the site."""

import pathlib
import shutil

from sphinx.application import Sphinx


def _bring(app: Sphinx) -> None:
    """Copies what has changed, so that what has not is not executed anew."""
    docs = pathlib.Path(app.srcdir)
    source, target = docs.parent / "notebooks", docs / "notebooks"
    target.mkdir(exist_ok=True)
    for old in target.glob("*.py"):
        if not (source / old.name).exists():
            old.unlink()
    for path in source.iterdir():
        copy = target / path.name
        if path.is_file() and (not copy.exists() or copy.read_bytes() != path.read_bytes()):
            shutil.copyfile(path, copy)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", _bring, priority=1)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
