"""Import PyBullet without printing its build time, which would appear in every notebook."""

import os

_saved = [(stream, os.dup(stream)) for stream in (1, 2)]
_null = os.open(os.devnull, os.O_WRONLY)
try:
    for _stream, _ in _saved:
        os.dup2(_null, _stream)
    import pybullet  # noqa: F401
finally:
    for _stream, _copy in _saved:
        os.dup2(_copy, _stream)
        os.close(_copy)
    os.close(_null)
