"""Equations as MathML, which browsers draw by themselves: pages need no script and no network."""

from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx


def _inline(self, node):
    self.body.append(tex2mathml(node.astext(), as_block=False))
    _skip()


def _display(self, node):
    numbered = node.get("number")
    self.body.append('<div class="math">')
    if numbered:
        self.body.append(f'<span class="eqno">({numbered})</span>')
    self.body.append(tex2mathml(node.astext(), as_block=True) + "</div>")
    _skip()


def _skip():
    from docutils import nodes

    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
