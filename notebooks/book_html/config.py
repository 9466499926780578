"""How the notebooks become web pages: `python -m nbconvert --config notebooks/book_html/config.py`.

Equations become MathML, which browsers draw without a script or a network.
"""

import re

from latex2mathml.converter import convert
from nbconvert.filters.markdown_mistune import IPythonRenderer


def block_math(self, body: str) -> str:
    """An equation of its own; its number, which MathML does not know, stands behind it."""
    body = re.sub(r"\\tag\{(.*?)\}", r"\\qquad\\text{(\1)}", body)
    return f'<span class="equation">{convert(body, display="block")}</span>'


IPythonRenderer.block_math = block_math
IPythonRenderer.inline_math = lambda self, body: convert(body)

c = get_config()
c.NbConvertApp.export_format = "html"
c.NbConvertApp.log_level = "ERROR"
c.FilesWriter.build_directory = "runs/html"
c.HTMLExporter.template_name = "book_html"
c.HTMLExporter.extra_template_basedirs = ["notebooks"]
c.HTMLExporter.embed_images = True
kinds = ["text/html", "image/svg+xml", "image/png", "text/markdown", "text/plain"]
c.NbConvertBase.display_data_priority = kinds
