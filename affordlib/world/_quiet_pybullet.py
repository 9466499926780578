"""Import PyBullet without printing its build time, which would appear in every notebook."""

import os

_saved, _null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
try:
    os.dup2(_null, 2)
    import pybullet  # noqa: F401
finally:
    os.dup2(_saved, 2)
    os.close(_saved)
    os.close(_null)
