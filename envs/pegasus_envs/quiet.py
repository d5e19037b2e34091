"""MJX without what it prints. It takes longer to import than MuJoCo: import it where an equation is first needed."""

import io
from contextlib import redirect_stdout

with redirect_stdout(io.StringIO()):  # that warp, which we do not use, is not installed
    from mujoco import mjx

__all__ = ["mjx"]
